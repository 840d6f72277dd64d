"""The order of stepping within a tick, from the inputs that are read at the end of a step.

An input read at the end of a step is direct feedthrough: its source steps first. An input read
at the start orders nothing; where it can, its consumer steps before the source, so that the
source's memory can be read in place.
"""

from __future__ import annotations

from collections import defaultdict

from terrafix.cosim.basics.errors import WiringError
from terrafix.cosim.system.flat import Connection, FlatSystem


def is_feedthrough(flat: FlatSystem, connection: Connection) -> bool:
    """Whether the source must step before the target within a tick."""
    return not connection.delay and flat.port(connection.target).at == "end"


def stepping_order(flat: FlatSystem) -> list[str]:
    """Paths of all components, sources before those who read them at the end of the step.

    Independent of the order of declaration.

    Raises
    ------
    WiringError
        If end-reads form a loop; the message prints it link by link.
    """
    before: dict[str, set[str]] = {path: set() for path in flat.components}
    preferred: dict[str, set[str]] = {path: set() for path in flat.components}
    for connection in flat.connections:
        source, target = flat.owner(connection.source), flat.owner(connection.target)
        if is_feedthrough(flat, connection):
            before[target].add(source)
        elif source != target and not connection.delay:
            preferred[source].add(target)
    done: list[str] = []
    waiting = dict(before)
    placed: set[str] = set()
    while waiting:
        ready = sorted(path for path, needs in waiting.items() if needs <= placed)
        if not ready:
            raise WiringError(_loop_text(flat, waiting, placed))
        happy = [path for path in ready if preferred[path] <= placed]
        choice = (happy or ready)[0]
        done.append(choice)
        placed.add(choice)
        del waiting[choice]
    return done


def _loop_text(flat: FlatSystem, waiting: dict[str, set[str]], placed: set[str]) -> str:
    """Find a shortest loop among the waiting components and print it."""
    links: dict[str, list[Connection]] = defaultdict(list)
    for connection in flat.connections:
        if is_feedthrough(flat, connection):
            links[flat.owner(connection.source)].append(connection)
    loop: list[Connection] | None = None
    for start in sorted(set(waiting) - placed):
        queue: list[tuple[str, list[Connection]]] = [(start, [])]
        seen = {start}
        while queue and (loop is None or len(queue[0][1]) < len(loop) - 1):
            path, taken = queue.pop(0)
            for connection in links[path]:
                target = flat.owner(connection.target)
                if target == start and (loop is None or len(taken) + 1 < len(loop)):
                    loop = [*taken, connection]
                elif target not in seen:
                    seen.add(target)
                    queue.append((target, [*taken, connection]))
    assert loop is not None
    ends = [(c.source, c.target) for c in loop]
    width = max(len(path) for pair in ends for path in pair)
    lines = ["algebraic loop"]
    for (source, target), (following, _) in zip(ends, [*ends[1:], ends[0]], strict=True):
        lines.append(f"  {source:<{width}} -> {target:<{width}} connected")
        lines.append(f"  {target:<{width}} => {following:<{width}} read at the end of the step")
    lines.append(
        "  connect an output that does not depend on the loop (a filter's 'prior', say), read one "
        "of these inputs at the start of its step, or give one connection a delay"
    )
    return "\n".join(lines)
