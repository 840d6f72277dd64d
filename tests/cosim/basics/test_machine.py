"""A process is told what it may use: the machine's, less what its container does not give."""

import os

import psutil
import pytest

from terrafix.cosim.basics import machine
from terrafix.cosim.basics.errors import ConfigurationError

MIB = 2**20


@pytest.fixture
def system(tmp_path, monkeypatch):
    """A machine of 8 processors and 1000 MiB whose system files say what the test writes."""
    monkeypatch.setattr(machine, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(machine, "_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(8)}, raising=False)
    memory = psutil.virtual_memory()._replace(available=1000 * MIB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    machine.cpu_features.cache_clear()

    def write(files):
        for name, text in files.items():
            file = tmp_path / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)

    yield write
    machine.cpu_features.cache_clear()


def test_of_this_machine():
    assert 1 <= machine.processors() <= os.cpu_count()
    if hasattr(os, "sched_getaffinity"):
        assert machine.processors() <= len(os.sched_getaffinity(0))
    assert 0 < machine.available_memory() <= psutil.virtual_memory().total
    assert machine.cpu_name()


def test_without_a_container_everything_is_there(system):
    assert machine.processors() == 8
    assert machine.available_memory() == 1000 * MIB


@pytest.mark.parametrize("affinity", [3, None])
def test_processors_where_the_standard_library_cannot_tell(system, monkeypatch, affinity):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    if affinity is None:
        monkeypatch.delattr(psutil.Process, "cpu_affinity", raising=False)
        monkeypatch.setattr(psutil, "cpu_count", lambda: 6)
    else:
        monkeypatch.setattr(psutil.Process, "cpu_affinity", lambda _: [*range(3)], raising=False)
    assert machine.processors() == (affinity or 6)


@pytest.mark.parametrize(
    ("quota", "expected"),
    [("max 100000", 8), ("150000 100000", 2), ("1000 100000", 1), ("9900000 100000", 8)],
)
def test_processors_of_a_container(system, quota, expected):
    system({"proc/self/cgroup": "0::/\n", "groups/cpu.max": f"{quota}\n"})
    assert machine.processors() == expected


@pytest.mark.parametrize(("quota", "expected"), [("-1", 8), ("250000", 3)])
def test_processors_of_a_container_of_version_1(system, quota, expected):
    system(
        {
            "proc/self/cgroup": "4:memory:/a\n3:cpu,cpuacct:/a\n0::/\n",
            "groups/cpu/a/cpu.cfs_quota_us": quota,
            "groups/cpu/a/cpu.cfs_period_us": "100000",
        }
    )
    assert machine.processors() == expected


def test_memory_of_a_container_is_what_is_left_less_what_can_be_had_again(system):
    system(
        {
            "proc/self/cgroup": "0::/outer/inner\n",
            "groups/outer/memory.max": f"{100 * MIB}\n",
            "groups/outer/memory.current": f"{70 * MIB}\n",
            "groups/outer/memory.stat": f"anon 7\ninactive_file {20 * MIB}\nactive_file 9\n",
            "groups/outer/inner/memory.max": "max\n",
            "groups/outer/inner/memory.current": f"{70 * MIB}\n",
        }
    )
    assert machine.available_memory() == 50 * MIB
    with pytest.raises(ConfigurationError, match=r"0\.1 GiB for a map, and 0\.0 GiB are"):
        machine.require_memory("terrain", 64 * MIB, "a map", "use a smaller one")
    machine.require_memory("terrain", 50 * MIB, "a map", "use a smaller one")


def test_memory_of_a_container_of_version_1_that_sees_the_paths_outside(system):
    system(
        {
            "proc/self/cgroup": "9:cpu:/docker/0123\n4:memory:/docker/0123\n",
            "groups/memory/memory.limit_in_bytes": f"{64 * MIB}\n",
            "groups/memory/memory.usage_in_bytes": f"{65 * MIB}\n",
            "groups/memory/memory.stat": "inactive_file 5\ntotal_inactive_file 3145728\n",
        }
    )
    assert machine.available_memory() == 2 * MIB


def test_a_container_that_uses_more_than_its_limit_has_nothing_left(system):
    system(
        {
            "proc/self/cgroup": "0::/a\n",
            "groups/a/memory.max": f"{64 * MIB}\n",
            "groups/a/memory.current": f"{70 * MIB}\n",
        }
    )
    assert machine.available_memory() == 0
    with pytest.raises(ConfigurationError, match=r"3\.0 GiB for a map, and 0\.0 GiB are"):
        machine.require_memory("terrain", 3 * 1024 * MIB, "a map", "use a smaller one")


def test_a_processor_is_named(system):
    system({"proc/cpuinfo": "model name\t: Fast 1\nflags\t: a b\n\nmodel name\t: Fast 1\n"})
    assert machine.cpu_name() == "Fast 1"
    assert machine.cpu_features() == "flags\t: a b\nmodel name\t: Fast 1"
