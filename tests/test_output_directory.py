"""Whole or not at all, and never over someone else's run."""

import json
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from causticmpi.errors import InputError
from causticmpi.output import directory as outdir
from causticmpi.output.directory import check_directory, claim_directory, write_run, write_whole
from causticmpi.output.exr import write_exr
from causticmpi.output.picture import Picture
from causticmpi.output.png import write_png
from causticmpi.output.report import build_report, write_report


def make_picture(width=7, height=5):
    noise = np.random.default_rng(1).random((height, width, 3))
    features = noise.astype(np.float32)
    return Picture(noise, noise, noise, noise, features, features, features[..., 0], film_size=(width, height))


def make_report(picture):
    fields: dict[str, Any] = dict(method="pt", biased=False, ranks=1, passes=2, spp=2, seed=1, nonfinite_samples=0)
    return build_report(picture, **fields, seconds={"total": 12.5}, rays=1000, memory_mb=1.0, provenance={})


def test_write_whole_replaces_in_one_step(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    seen = []

    def writer(temporary):
        temporary.write_text("new")
        seen.append((temporary.parent, path.read_text()))

    old_mask = os.umask(0o027)
    try:
        write_whole(path, writer)
    finally:
        os.umask(old_mask)
    assert seen == [(tmp_path, "old")]
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_write_whole_that_fails_midway_leaves_the_old_file(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def writer(temporary):
        temporary.write_text("ne")
        raise error("midway")

    with pytest.raises(error, match="midway"):
        write_whole(path, writer)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_full_disk_leaves_the_old_run(tmp_path):
    """A limit on the size of files stands in for the full disk: every writer has to notice it."""
    picture = make_picture(width=300, height=200)
    report = make_report(picture)
    write_run(tmp_path, picture, report, {})
    before = {name: (tmp_path / name).read_bytes() for name in os.listdir(tmp_path)}
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (512, hard))
    try:
        for name in outdir.RESULTS:
            writers = {
                outdir.EXR: lambda path: write_exr(path, picture, {}),
                outdir.PNG: lambda path: write_png(path, picture.rgb),
                outdir.REPORT: lambda path: write_report(path, report),
            }
            with pytest.raises((OSError, RuntimeError)):
                write_whole(tmp_path / name, writers[name])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert {name: (tmp_path / name).read_bytes() for name in os.listdir(tmp_path)} == before


def test_write_run_leaves_three_files_the_report_last(tmp_path, monkeypatch):
    order = []
    real = os.replace

    def replace(source, target):
        order.append(Path(target).name)
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    report = make_report(make_picture())
    spent = write_run(tmp_path, make_picture(), report, {"method": "pt"})
    assert order == ["image.exr", "image.png", "report.json"]
    assert sorted(os.listdir(tmp_path)) == sorted(order)
    seconds = json.loads((tmp_path / "report.json").read_text())["seconds"]
    assert 0 < seconds["write"] < spent
    assert seconds["total"] == pytest.approx(12.5 + seconds["write"])
    assert report["seconds"]["write"] == 0


# Claims


@pytest.mark.parametrize(
    "name", ["image.exr", "image.png", "report.json", "checkpoint", "checkpoint-3.npz", "unfinished"]
)
def test_a_directory_with_a_run_is_refused(tmp_path, name):
    (tmp_path / name).write_text("old")
    for refuse in (check_directory, claim_directory):
        with pytest.raises(InputError) as caught:
            refuse(tmp_path)
        message = str(caught.value)
        assert message.startswith(f"{tmp_path}: ") and "\n" not in message
        assert all(word in message for word in (name, "--force", "--resume", "--out"))
        refuse(tmp_path, force=True)
        refuse(tmp_path, resume=True)
    assert (tmp_path / name).read_text() == "old"
    assert os.listdir(tmp_path) == [name]


def test_other_peoples_files_do_not_matter(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    check_directory(tmp_path)
    assert claim_directory(tmp_path).directory == tmp_path
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_check_leaves_no_directories_and_claim_does(tmp_path):
    target = tmp_path / "a" / "b" / "c"
    check_directory(target)
    assert os.listdir(tmp_path) == []
    claim_directory(target)
    assert target.is_dir() and os.listdir(target) == []


@pytest.mark.parametrize("tail", ["file", "file/x", "file/x/y", "dangling", "n" * 300, "ok/" + "n" * 300, "nul\0"])
def test_places_that_cannot_be_directories_are_refused(tmp_path, tail):
    (tmp_path / "file").write_text("x")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere" / "at all")
    before = sorted(os.listdir(tmp_path))
    why = "it is a file.*--out" if tail == "file" else "--out"
    for refuse in (check_directory, claim_directory):
        with pytest.raises(InputError, match=why):
            refuse(tmp_path / tail, force=True)
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("tail", ["", "x/y"])
def test_places_that_cannot_be_written_to_are_refused(tmp_path, tail):
    """root may write whatever the permissions say, so root gets a directory that no one can write to."""
    parent = tmp_path
    if os.geteuid() == 0:
        parent = Path("/proc/self/task")
    else:
        tmp_path.chmod(0o555)
    with pytest.raises(InputError, match="cannot be written to"):
        check_directory(parent / tail)
    if os.geteuid() != 0:
        tmp_path.chmod(0o755)


def test_a_result_that_cannot_be_replaced_is_refused_before_the_run(tmp_path):
    (tmp_path / "image.png").mkdir()
    with pytest.raises(InputError, match="image.png is a directory"):
        check_directory(tmp_path, force=True)


def test_force_keeps_the_old_run_until_the_new_one_is_there(tmp_path):
    for name in ("image.exr", "image.png", "report.json", "checkpoint-0", "checkpoint-1", "unfinished", "notes.txt"):
        (tmp_path / name).write_text("old")
    (tmp_path / ".causticmpi-image.exr-00.tmp").write_text("half")
    claim = claim_directory(tmp_path, force=True)
    kept = {"image.exr", "image.png", "report.json", "checkpoint-0", "checkpoint-1", "unfinished", "notes.txt"}
    assert {name for name in os.listdir(tmp_path) if (tmp_path / name).read_text() == "old"} == kept
    assert set(os.listdir(tmp_path)) == kept
    write_run(tmp_path, make_picture(), make_report(make_picture()), {})
    write_whole(tmp_path / "checkpoint-0", lambda path: path.write_text("new"))
    claim.discard_stale()
    claim.discard_stale()
    assert set(os.listdir(tmp_path)) == kept - {"checkpoint-1", "unfinished"}
    assert (tmp_path / "checkpoint-0").read_text() == "new"
    assert (tmp_path / "image.exr").read_bytes()[:4] == b"\x76\x2f\x31\x01"


def test_resume_keeps_the_state_it_goes_on_from(tmp_path):
    (tmp_path / "checkpoint").write_text("old")
    for force in (False, True):
        claim = claim_directory(tmp_path, force=force, resume=True)
        claim.discard_stale()
        assert os.listdir(tmp_path) == ["checkpoint"]
