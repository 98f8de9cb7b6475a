"""Memory and cores of the machine and limits of control groups v1 and v2, read from synthetic files."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import numpy as np
import psutil
import pytest

from linprim_geo.base.control_groups import container, group_folders
from linprim_geo.base.cores import core_quota, usable_cores
from linprim_geo.base.memory import available_memory, forget_peak, memory_gib, peak_gib, total_memory

MIB = 2**20
FREE, TOTAL = 10_000 * MIB, 16_000 * MIB
NO_LIMIT = 9223372036854771712  # what version 1 says


@pytest.fixture
def machine(monkeypatch):
    """A machine with 16,000 MiB of memory, 10,000 of them available, and 8 cores."""
    memory = psutil.virtual_memory()._replace(available=FREE, total=TOTAL)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)


def write(root, files):
    for name, text in files.items():
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{text}\n")


def stat(inactive, active, prefix=""):
    """Text of memory.stat. Its cache includes shared memory, which cannot be reclaimed."""
    text = f"cache {5000 * MIB}\nshmem {4000 * MIB}\ninactive_anon {9 * MIB}\n"
    return text + f"{prefix}inactive_file {inactive * MIB}\n{prefix}active_file {active * MIB}"


def test_without_control_groups_the_machine_sets_the_limits(machine, tmp_path):
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (FREE, TOTAL, 8)


def test_cgroup_v2_limits_memory_and_cores(machine, tmp_path):
    """Inside a container its own group is the root of the hierarchy."""
    write(tmp_path, {"proc/self/cgroup": "0::/"})
    group = "sys/fs/cgroup"
    write(tmp_path, {f"{group}/memory.max": 3000 * MIB, f"{group}/memory.current": 2900 * MIB})
    write(tmp_path, {f"{group}/cpu.max": "250000 100000"})
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (100 * MIB, 3000 * MIB, 3)
    write(tmp_path, {f"{group}/memory.stat": stat(inactive=700, active=200)})
    assert available_memory(tmp_path) == 1000 * MIB
    write(tmp_path, {f"{group}/memory.max": "max", f"{group}/cpu.max": "max 100000"})
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (FREE, TOTAL, 8)


def test_tightest_limit_of_all_parent_groups_applies(machine, tmp_path):
    """The slice limits the memory, and the service inside it limits the cores."""
    write(tmp_path, {"proc/self/cgroup": "0::/work.slice/job.service"})
    slices, job = "sys/fs/cgroup/work.slice", "sys/fs/cgroup/work.slice/job.service"
    write(tmp_path, {f"{slices}/memory.max": 4000 * MIB, f"{slices}/memory.current": 1500 * MIB})
    write(tmp_path, {f"{slices}/memory.stat": stat(inactive=500, active=0), f"{slices}/cpu.max": "600000 100000"})
    write(tmp_path, {f"{job}/memory.max": "max", f"{job}/memory.current": 900 * MIB, f"{job}/cpu.max": "50000 100000"})
    root = tmp_path / "sys/fs/cgroup"
    assert group_folders("memory", tmp_path) == [root / "work.slice/job.service", root / "work.slice", root]
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (3000 * MIB, 4000 * MIB, 1)
    write(tmp_path, {f"{job}/memory.max": 1000 * MIB})
    assert (available_memory(tmp_path), total_memory(tmp_path)) == (100 * MIB, 1000 * MIB)


@pytest.mark.parametrize("inside", [False, True])
def test_cgroup_v1_limits_are_read_per_controller(inside, machine, tmp_path):
    """Inside a container /proc names the groups of the host, but the group itself is the root of the mount."""
    write(tmp_path, {"proc/self/cgroup": "4:memory:/docker/abc\n3:cpu,cpuacct:/docker/abc\n1:name=systemd:/x\n0::/"})
    name = "" if inside else "/docker/abc"
    memory, cores = f"sys/fs/cgroup/memory{name}", f"sys/fs/cgroup/cpu{name}"
    write(tmp_path, {f"{memory}/memory.limit_in_bytes": 2000 * MIB, f"{memory}/memory.usage_in_bytes": 1950 * MIB})
    write(tmp_path, {f"{memory}/memory.stat": f"inactive_file {MIB}\n{stat(600, 50, prefix='total_')}"})
    write(tmp_path, {f"{cores}/cpu.cfs_quota_us": 150000, f"{cores}/cpu.cfs_period_us": 100000})
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (700 * MIB, 2000 * MIB, 2)
    write(tmp_path, {f"{memory}/memory.limit_in_bytes": NO_LIMIT, f"{cores}/cpu.cfs_quota_us": -1})
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (FREE, TOTAL, 8)


def test_cgroup_v1_controllers_may_share_a_hierarchy(machine, tmp_path):
    write(tmp_path, {"proc/self/cgroup": "3:cpu,cpuacct:/job"})
    cores = "sys/fs/cgroup/cpu,cpuacct/job"
    write(tmp_path, {f"{cores}/cpu.cfs_quota_us": 150000, f"{cores}/cpu.cfs_period_us": 100000})
    assert usable_cores(tmp_path) == 2 and core_quota(tmp_path) == 1.5


def test_memory_high_limits_memory(machine, tmp_path):
    group = "sys/fs/cgroup"
    write(tmp_path, {"proc/self/cgroup": "0::/", f"{group}/memory.max": "max", f"{group}/memory.high": 2000 * MIB})
    write(tmp_path, {f"{group}/memory.current": 500 * MIB})
    assert (available_memory(tmp_path), total_memory(tmp_path)) == (1500 * MIB, 2000 * MIB)


def test_kind_of_container_is_detected(monkeypatch, tmp_path):
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    assert container(tmp_path) is None
    write(tmp_path, {"run/systemd/container": "lxc"})
    assert container(tmp_path) == "lxc"
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.0.0.1")
    assert container(tmp_path) == "kubernetes"
    write(tmp_path, {".dockerenv": ""})
    assert container(tmp_path) == "docker"


def test_kernels_use_at_most_the_cores_of_the_affinity_mask():
    program = "import os; os.cpu_count = lambda: 9; os.sched_getaffinity = lambda pid: set(range(3))\n"
    program += "from linprim_geo.kernels import ops; print(ops.threads())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "3\n" or usable_cores() < 3


def test_usage_above_the_limit_leaves_no_memory(machine, tmp_path):
    group = "sys/fs/cgroup"
    write(tmp_path, {"proc/self/cgroup": "0::/", f"{group}/memory.max": 10 * MIB})
    write(tmp_path, {f"{group}/memory.current": 12 * MIB})
    assert available_memory(tmp_path) == 0


@pytest.mark.parametrize("text", ["", "nonsense", "0:", "0::/../../other"])
def test_malformed_control_group_files_set_no_limit(text, machine, tmp_path):
    group = "sys/fs/cgroup"
    write(tmp_path, {"proc/self/cgroup": text, f"{group}/memory.max": "?", f"{group}/memory.current": ""})
    write(tmp_path, {f"{group}/cpu.max": "many"})
    assert (available_memory(tmp_path), total_memory(tmp_path), usable_cores(tmp_path)) == (FREE, TOTAL, 8)


def test_this_machine_has_memory_and_cores():
    assert 0 < available_memory() <= total_memory() and 1 <= usable_cores() <= os.cpu_count()


@pytest.mark.skipif(not os.path.exists("/proc/self/clear_refs"), reason="the peak can be forgotten on Linux alone")
def test_forget_peak_resets_the_peak_of_memory():
    held = np.ones(2**26)  # half a GiB
    resident = memory_gib()
    with_array = peak_gib()  # read second, because a reading allocates pages itself
    assert with_array >= resident > held.nbytes / 2**30
    del held
    assert peak_gib() == pytest.approx(with_array, abs=0.1)
    forget_peak()
    assert peak_gib() < with_array - 0.3


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators are left alone")
def test_give_back_returns_freed_memory_to_the_system():
    """Once a larger array was freed, arrays of 1 MiB come from the heap, which small arrays between them fragment."""
    program = """
import numpy as np
from linprim_geo.base.memory import give_back, memory_gib
np.ones(20 << 20, np.uint8)
small, large = [], []
for _ in range(300):
    large.append(np.ones(1 << 20, np.uint8))
    small.append(np.ones(1000, np.uint8))
held = memory_gib()
del large
freed = memory_gib()
give_back()
print(held, freed, memory_gib())
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    held, freed, given_back = map(float, said.split())
    assert freed > held - 0.1 and given_back < held - 0.25
