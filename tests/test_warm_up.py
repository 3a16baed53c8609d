"""Warming up makes ready just what renders run."""

from numba import typeof
from rendering import REPOSITORY, prepare

from causticmpi.distributed.warmup import tiny_scene
from causticmpi.scene.load import load_scene


def test_warm_up_compiles_what_renders_need() -> None:
    """The types of the tiny scene's arrays are those of a real one: else every kernel would be compiled twice, the
    second time out of the budget."""
    tiny = prepare(tiny_scene()).traced
    real = prepare(load_scene(REPOSITORY / "scenes" / "cornell.yaml")).traced
    assert [typeof(array) for array in tiny] == [typeof(array) for array in real]
