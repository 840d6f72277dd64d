"""Lines and tables that a person reads: in a terminal, as plain text, and in a notebook.

What is shown is a list of `Table`, `rich.text.Text` and plain texts, in the order of reading; an
object that is `Shown` gives such a list, and has its repr and its HTML from it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

if TYPE_CHECKING:
    import rich.table
    import rich.text

WIDTH = 80
"""Columns of a plain text."""
_GRID = "border-collapse:collapse;margin:.6em 0"
_CELL = {
    "th": "padding:.15em 1.2em .15em 0;border-bottom:1px solid #999;vertical-align:bottom",
    "td": "padding:.15em 1.2em .15em 0;vertical-align:top",
}
Item = TypeVar("Item")


class Table:
    """Rows of texts under headers.

    Parameters
    ----------
    headers : sequence of str
    rows : iterable of sequences of str
    words : int, optional
        Number of columns that hold words; those after them hold numbers and stand to the right.
        All hold words if absent.
    grouped : bool
        Leave a gap before a row whose first cell is not empty.
    """

    def __init__(
        self,
        headers: Sequence[str],
        rows: Iterable[Sequence[str]],
        *,
        words: int | None = None,
        grouped: bool = False,
    ) -> None:
        self.headers = list(headers)
        self.rows = [list(row) for row in rows]
        self.words = len(self.headers) if words is None else words
        self.grouped = grouped

    def __rich__(self) -> rich.table.Table:
        """The table as it stands in a terminal; long cells are folded, never cut."""
        from rich import box
        from rich.table import Table as Drawn
        from rich.text import Text

        drawn = Drawn(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
        for i, header in enumerate(self.headers):
            side: Literal["left", "right"] = "left" if i < self.words else "right"
            drawn.add_column(Text(header), overflow="fold", justify=side)
        for number, row in enumerate(self.rows, 1):
            last = number == len(self.rows) or bool(self.rows[number][0])
            drawn.add_row(*map(Text, row), end_section=self.grouped and last)
        return drawn

    def __str__(self) -> str:
        return text([self])

    def _repr_html_(self) -> str:
        def cell(tag: str, i: int, content: str) -> str:
            side = "left" if i < self.words else "right"
            shown = escape(content).replace("\n", "<br>")
            return f'<{tag} style="text-align:{side};{_CELL[tag]}">{shown}</{tag}>'

        def line(tag: str, cells: Sequence[str]) -> str:
            return f"<tr>{''.join(cell(tag, i, c) for i, c in enumerate(cells))}</tr>"

        head, body = line("th", self.headers), "".join(line("td", row) for row in self.rows)
        return f'<table style="{_GRID}"><thead>{head}</thead><tbody>{body}</tbody></table>'


Block: TypeAlias = "Table | rich.text.Text | str"


class Shown:
    """What shows itself at a prompt and in a notebook, whatever state it is in."""

    def _shown(self) -> Sequence[Block]:
        """Tables and lines, in the order of reading."""
        raise NotImplementedError(f"{type(self).__name__} must provide _shown()")

    def __rich_console__(self, *console: object) -> Iterator[Block]:
        yield from self._shown()

    def __repr__(self) -> str:
        try:
            return text(self._shown())
        except Exception as error:  # half built, say: a repr is what one looks with
            return f"<{type(self).__name__} that cannot be shown: {_cause(error)}>"

    def _repr_html_(self) -> str:
        try:
            return html(self._shown())
        except Exception as error:
            name = escape(type(self).__name__)
            return f"<div>{name} that cannot be shown: {escape(_cause(error))}</div>"


def _cause(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def text(blocks: Sequence[Block], *, width: int = WIDTH) -> str:
    """What is shown, as plain text without colors; lines have at most `width` columns."""
    from io import StringIO

    from rich.console import Console

    file = StringIO()
    console = Console(
        file=file, width=width, color_system=None, force_jupyter=False, legacy_windows=False
    )
    for block in blocks:
        console.print(block, markup=False, highlight=False)
    lines = [line.rstrip() for line in file.getvalue().splitlines()]
    return "\n".join(lines).strip("\n")


def html(blocks: Sequence[Block]) -> str:
    """What is shown, as HTML: everything escaped, styles kept."""
    return f"<div>{''.join(map(_html, blocks))}</div>"


def _html(block: Block) -> str:
    if isinstance(block, Table):
        return block._repr_html_()
    spans = _spans(block)
    return f'<div style="white-space:pre-wrap">{spans}</div>' if spans else ""


def _spans(block: rich.text.Text | str) -> str:
    """A line of text with the styles of its parts."""
    if isinstance(block, str):
        return escape(block)
    from rich.console import Console
    from rich.style import Style
    from rich.terminal_theme import DEFAULT_TERMINAL_THEME

    console = Console(width=10_000, color_system="standard", force_terminal=True)
    parts = []
    for segment in console.render(block):
        style = (segment.style or Style()).get_html_style(DEFAULT_TERMINAL_THEME)
        shown = escape(segment.text)
        parts.append(f'<span style="{style}">{shown}</span>' if style else shown)
    return "".join(parts).strip("\n")


def first(items: Iterable[Item], most: int) -> tuple[list[Item], int]:
    """The first items of a list that is to be short, and how many are left out.

    One item too many is shown rather than counted: the count would take the same line.
    """
    listed = list(items)
    kept = listed if len(listed) <= most + 1 else listed[:most]
    return kept, len(listed) - len(kept)


def named(items: Iterable[str], most: int) -> str:
    """Names in one line, the first of them and how many more."""
    kept, more = first(items, most)
    return ", ".join(kept) + (f" and {more} more" if more else "")
