"""Memory that a render may take: the least of machine, cgroups and SLURM job, for all ranks of a node."""

import math
from pathlib import Path

import pytest
from program_tools import CORNELL

from causticmpi.config.load import load_config, scene_path
from causticmpi.errors import InputError
from causticmpi.render import memory
from causticmpi.render.memory import MB, cgroup_limit, check_memory, memory_needed, memory_there
from causticmpi.scene.load import load_scene


def limit(tmp_path: Path, groups: str, **files: int | str) -> float:
    """`cgroup_limit` of a pretended kernel; files: by path below the mount."""
    (tmp_path / "self").write_text(groups)
    for name, content in files.items():
        file = tmp_path / "fs" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{content}\n")
    return cgroup_limit(tmp_path / "self", tmp_path / "fs")


def test_the_least_of_a_group_and_those_above_it(tmp_path: Path) -> None:
    files = {"job/step/memory.max": "max", "job/memory.max": 300 * 2**20, "memory.max": 500 * 2**20}
    assert limit(tmp_path, "0::/job/step\n", **files) == 300
    assert limit(tmp_path, "0::/elsewhere\n") == 500


def test_version_one(tmp_path: Path) -> None:
    files = {"memory/a/memory.limit_in_bytes": 2**63 - 4096, "memory/memory.limit_in_bytes": 200 * 2**20}
    assert limit(tmp_path, "9:name=systemd:/a\n4:hugetlb,memory:/a\n0::/\n", **files) == 200


def test_no_limit(tmp_path: Path) -> None:
    assert cgroup_limit(tmp_path / "none", tmp_path) == math.inf
    assert limit(tmp_path, "0::/\n3:cpu:/\n", **{"memory.max": "max"}) == math.inf


def test_a_job_may_have_less_than_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "cgroup_limit", lambda: 64.0)
    assert memory_there({}) == (64.0, " (the limit of its cgroup)")
    assert memory_there({"SLURM_MEM_PER_NODE": "32"}) == (32.0, " (SLURM_MEM_PER_NODE)")
    by_cpu = {"SLURM_MEM_PER_CPU": "16", "SLURM_CPUS_ON_NODE": "3"}
    assert memory_there(by_cpu) == (48.0, " (SLURM_MEM_PER_CPU on 3 CPUs)")
    for untold in ({"SLURM_MEM_PER_CPU": "16"}, by_cpu | {"SLURM_MEM_PER_CPU": "0"}, {"SLURM_CPUS_ON_NODE": "3"}):
        assert memory_there(untold)[0] == 64
    for said in ("0", "many", ""):
        assert memory_there({"SLURM_MEM_PER_NODE": said})[0] == 64
    monkeypatch.setattr(memory, "cgroup_limit", lambda: math.inf)
    machine, source = memory_there({})
    assert source == "" and 100 < machine < 2**30 * MB


def test_all_ranks_of_the_node_count(monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_config(CORNELL)
    scene = load_scene(scene_path(CORNELL, config))
    needed = memory_needed(config, scene)
    room = needed.node + 3.5 * needed.rank
    monkeypatch.setattr(memory, "memory_there", lambda: (room, " (SLURM_MEM_PER_NODE)"))
    check_memory(config, scene, 3)
    with pytest.raises(InputError, match=r"on 4 ranks; .* of this machine \(SLURM_MEM_PER_NODE\); .* fewer ranks"):
        check_memory(config, scene, 4)
