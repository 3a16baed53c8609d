"""The files a run leaves behind: readable by others, exact, and written whole or not at all."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from causticmpi import __version__
from causticmpi.output import exr
from causticmpi.output.exr import write_exr
from causticmpi.output.picture import Picture, estimated_relmse
from causticmpi.output.png import srgb_bytes, write_png
from causticmpi.output.report import STAGES, attributes_from_report, build_report, provenance, write_report

LAYERS = {
    "R": ("rgb", 0),
    "G": ("rgb", 1),
    "B": ("rgb", 2),
    **{
        f"{layer}.{axis}": (layer, i)
        for layer, axes in (
            ("diffusive", "RGB"),
            ("caustic", "RGB"),
            ("variance", "RGB"),
            ("albedo", "RGB"),
            ("normal", "XYZ"),
        )
        for i, axis in enumerate(axes)
    },
    "depth.Z": ("depth", None),
}


def make_picture(width=7, height=5, crop=None, film=None):
    """Every value of every layer is different, so that a swapped channel, row or column shows."""
    shape = (height, width, 3)
    values = np.random.default_rng(7).permutation(6 * height * width * 3).reshape(6, *shape) / 8.0
    names = ("rgb", "diffusive", "caustic", "variance", "albedo", "normal")
    layers = {name: values[i] if i < 4 else values[i].astype(np.float32) for i, name in enumerate(names)}
    depth = (1000 + np.arange(height * width)).reshape(height, width).astype(np.float32)
    return Picture(**layers, depth=depth, film_size=film or (width, height), crop=crop)


def make_report(picture, **changes):
    source = provenance(["causticmpi", "render", "a b.yaml"], {"hosts": ["n1", "n2"], "mpi": "MPICH 5.0"}, "abc123")
    fields: dict[str, Any] = dict(
        method="iws+cf", biased=False, ranks=2, passes=4, spp=8, seed=2**40, nonfinite_samples=3
    )
    fields |= dict(seconds={"total": 12.5, "tracing": 10.0}, rays=1000, memory_mb=320.0, provenance=source)
    return build_report(picture, **(fields | changes))


def expected(picture, channel):
    name, i = LAYERS[channel]
    values = getattr(picture, name)
    return (values if i is None else values[..., i]).astype(np.float32)


def stored(picture, path):
    """Write with the attributes of a whole report; returns them."""
    attributes = attributes_from_report(make_report(picture), "scene: ../é.yaml\nseed: 1\n")
    write_exr(path, picture, attributes)
    return attributes


@pytest.fixture(params=[None, (3, 2, 10, 7)], ids=["whole", "crop"])
def picture(request):
    return make_picture(crop=request.param, film=request.param and (20, 9))


# EXR


def test_openexr_reads_every_layer_and_attribute(tmp_path, picture):
    import OpenEXR

    path = tmp_path / "image.exr"
    stored(picture, path)
    file = OpenEXR.File(str(path), separate_channels=True)
    assert len(file.parts) == 1
    assert set(file.channels()) == set(LAYERS)
    for channel in LAYERS:
        pixels = file.channels()[channel].pixels
        assert pixels.dtype == np.float32
        np.testing.assert_array_equal(pixels, expected(picture, channel), err_msg=channel)
    header = file.header()
    assert header["config"] == "scene: ../é.yaml\nseed: 1\n"
    assert (header["method"], header["biased"], header["passes"], header["ranks"]) == ("iws+cf", "no", 4, 2)
    assert header["seconds"] == 12.5
    assert header["seed"] == str(2**40)
    assert header["command"] == "causticmpi render 'a b.yaml'"
    assert (header["hosts"], header["mpi"], header["sceneHash"]) == ("n1 n2", "MPICH 5.0", "abc123")
    assert json.loads(header["provenance"])["versions"]["numpy"] == np.__version__
    assert "4 independent passes" in header["varianceNote"]
    np.testing.assert_allclose(header["chromaticities"], exr.REC709, rtol=1e-6)
    assert header["software"] == f"causticmpi {header['causticmpiVersion']}" == f"causticmpi {__version__}"
    x0, y0, x1, y1 = picture.window
    np.testing.assert_array_equal(header["dataWindow"], [[x0, y0], [x1 - 1, y1 - 1]])
    np.testing.assert_array_equal(header["displayWindow"], [[0, 0], np.subtract(picture.film_size, 1)])


def test_openimageio_reads_every_layer_and_attribute(tmp_path, picture, capfd):
    oiio = pytest.importorskip("OpenImageIO", reason="OpenImageIO is not installed (extra `test` has it)")
    path = tmp_path / "image.exr"
    attributes = stored(picture, path)
    image = oiio.ImageInput.open(str(path))
    spec = image.spec()
    pixels = image.read_image("float")
    assert (spec.x, spec.y, spec.x + spec.width, spec.y + spec.height) == picture.window
    assert (spec.full_width, spec.full_height, spec.full_x, spec.full_y) == (*picture.film_size, 0, 0)
    assert not image.seek_subimage(1, 0)
    assert set(spec.channelnames) == set(LAYERS) and spec.channelnames[:3] == ("R", "G", "B")
    for i, channel in enumerate(spec.channelnames):
        np.testing.assert_array_equal(pixels[..., i], expected(picture, channel), err_msg=channel)
    found = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    for name, value in attributes.items():
        wanted = pytest.approx(value, rel=1e-6) if isinstance(value, float) else value
        assert found[name] == (str(value) if name == "seed" else wanted), name
    assert {"config", "method", "passes", "seed", "ranks", "seconds", "biased", "provenance"} <= set(attributes)
    assert found["causticmpiVersion"] == __version__
    assert capfd.readouterr() == ("", "")  # where the library complains of attributes it cannot read


def test_exr_keeps_nonfinite_pixels(tmp_path):
    import OpenEXR

    picture = make_picture()
    picture.rgb[1, 2] = [np.nan, np.inf, -1.0]
    picture.rgb[0, 0, 0] = 1e300
    write_exr(tmp_path / "a.exr", picture, {})
    channels = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    np.testing.assert_array_equal([channels[c].pixels[1, 2] for c in "RGB"], [np.nan, np.inf, -1.0])
    assert np.isposinf(channels["R"].pixels[0, 0])


def test_exr_attributes_of_every_kind(tmp_path):
    import OpenEXR

    values: dict[str, Any] = {
        "t": True,
        "n": np.int64(3),
        "f": np.float32(2.5),
        "low": -(2**31),
        "high": 2**31 - 1,
        "over": 2**31,
        "under": -(2**31) - 1,
        "big": 2**63 - 1,
    }
    write_exr(tmp_path / "a.exr", make_picture(), values)
    header = OpenEXR.File(str(tmp_path / "a.exr")).header()
    assert {name: header[name] for name in values} == {
        **{"t": "yes", "n": 3, "f": 2.5, "low": -(2**31), "high": 2**31 - 1},
        **{"over": "2147483648", "under": "-2147483649", "big": "9223372036854775807"},
    }
    for name in ("dataWindow", "version"):
        with pytest.raises(ValueError, match=name):
            write_exr(tmp_path / "b.exr", make_picture(), {name: "x"})
    with pytest.raises(TypeError, match="NoneType"):
        write_exr(tmp_path / "b.exr", make_picture(), {"a": None})  # type: ignore[dict-item]
    assert not (tmp_path / "b.exr").exists()


# Picture


def test_picture_refuses_arrays_that_disagree():
    good = make_picture()
    for changes in ({"depth": good.depth[:-1]}, {"caustic": good.caustic[..., 0]}, {"film_size": (5, 7)}):
        with pytest.raises(ValueError, match="shape"):
            Picture(**{**vars(good), **changes})
    with pytest.raises(ValueError, match="window of the film"):
        make_picture(crop=(14, 0, 21, 5), film=(20, 9))


def test_estimated_relmse_by_hand():
    rgb = np.array([[[0.0, 0.3, 2.0]]])
    variance = np.array([[[0.01, 0.2, 0.0]]])
    assert estimated_relmse(rgb, variance) == pytest.approx((1.0 + 2.0 + 0.0) / 3)
    assert np.isnan(estimated_relmse(np.full((2, 2, 3), np.nan), np.zeros((2, 2, 3))))


# PNG


def test_srgb_bytes_of_known_radiance():
    # Byte values by the published curve: linear 0.2140 is byte 127.5, so the two neighbours straddle it.
    radiance = [0.0, -3.0, 1e-3, 0.0031308, 0.0185, 0.18, 0.2139, 0.2142, 0.5, 0.9999, 1.0, 1e30]
    wanted = [0, 0, 3, 10, 37, 118, 127, 128, 188, 255, 255, 255]
    assert srgb_bytes(np.array(radiance).reshape(1, 4, 3)).ravel().tolist() == wanted


def test_srgb_bytes_inverts_every_byte():
    bytes_ = np.arange(256) / 255.0
    linear = np.where(bytes_ <= 0.04045, bytes_ / 12.92, ((bytes_ + 0.055) / 1.055) ** 2.4)
    grey = np.repeat(linear[None, :, None], 3, axis=2)
    np.testing.assert_array_equal(srgb_bytes(grey)[0, :, 1], np.arange(256))


def test_png_as_pillow_reads_it(tmp_path):
    from PIL import Image, PngImagePlugin

    rgb = np.zeros((2, 3, 3))
    rgb[0, 0] = [0.25, 0.0, 2.0]
    rgb[1, 2] = [np.nan, 0.5, 0.5]
    rgb[0, 1] = [np.inf, 0.5, 0.5]
    write_png(tmp_path / "a.png", rgb)
    with Image.open(tmp_path / "a.png") as image:
        assert isinstance(image, PngImagePlugin.PngImageFile)
        pixels = np.asarray(image)
        assert (image.mode, image.size) == ("RGB", (3, 2))
        assert image.text["Software"].startswith("causticmpi ")
        assert image.text["Exposure"].startswith("+0 stops (radiance x 1,")
        assert image.text["NonfinitePixels"].startswith("2 ")
        assert image.info["srgb"] == 0
    assert pixels[0, 0].tolist() == [137, 0, 255]
    assert pixels[1, 2].tolist() == pixels[0, 1].tolist() == [255, 0, 255]
    assert pixels[1, 0].tolist() == [0, 0, 0]


def test_png_of_a_clean_picture_names_no_pixels(tmp_path):
    from PIL import Image, PngImagePlugin

    write_png(tmp_path / "a.png", np.ones((2, 2, 3)))
    with Image.open(tmp_path / "a.png") as image:
        assert isinstance(image, PngImagePlugin.PngImageFile)
        assert set(image.text) == {"Software", "Exposure"}
        assert image.text["Exposure"].startswith("+0 stops")


# Report


def refuse_constant(name):
    raise AssertionError(f"{name} is not JSON")


def read_strictly(path):
    return json.loads(Path(path).read_text(encoding="utf-8"), parse_constant=refuse_constant)


def test_report_has_the_keys_of_the_contract(tmp_path):
    picture = make_picture(width=7, height=5)
    write_report(tmp_path / "report.json", make_report(picture))
    report = read_strictly(tmp_path / "report.json")
    assert list(report["seconds"]) == list(STAGES)
    assert (report["seconds"]["tracing"], report["seconds"]["photons"]) == (10.0, 0.0)
    assert report["rays"] == {"total": 1000, "per_second": 80.0}
    assert report["biased"] is False and report["seed"] == 2**40
    assert (report["width"], report["height"]) == (7, 5)
    assert report["estimated_relmse"] == pytest.approx(np.mean(picture.variance / (picture.rgb**2 + 0.01)))
    assert report["warnings"] == []
    keys = "method biased ranks passes spp width height seed nonfinite_samples estimated_relmse seconds rays memory_mb"
    assert list(report) == [*keys.split(), "provenance", "warnings"]
    assert report["provenance"]["hosts"] == ["n1", "n2"]
    assert report["provenance"]["started"].endswith("+00:00")
    with pytest.raises(ValueError, match="lunch"):
        make_report(picture, seconds={"lunch": 1.0})


def test_report_of_one_pass_says_that_there_is_no_variance(tmp_path):
    report = make_report(make_picture(), passes=1)
    write_report(tmp_path / "report.json", report)
    read = read_strictly(tmp_path / "report.json")
    assert read["estimated_relmse"] is None
    assert "estimated_relmse" in read["warnings"][0]
    attributes = attributes_from_report(report, "")
    assert "estimatedRelmse" not in attributes and "is 0" in str(attributes["varianceNote"])


def test_report_is_strict_json_with_nonfinite_numbers(tmp_path):
    report = make_report(make_picture(), memory_mb=float("nan"), warnings=["mine"])
    report["seconds"]["load"] = np.float64("inf")
    report["extra"] = {"list": [1.0, np.float32("-inf")], "array": np.arange(3), "count": np.int64(4)}
    write_report(tmp_path / "report.json", report)
    read = read_strictly(tmp_path / "report.json")
    assert (read["memory_mb"], read["seconds"]["load"], read["extra"]["list"]) == (None, None, [1.0, None])
    assert (read["extra"]["array"], read["extra"]["count"]) == ([0, 1, 2], 4)
    assert read["warnings"][0] == "mine"
    assert [line.split()[0] for line in read["warnings"][1:]] == ["seconds.load", "memory_mb", "extra.list[1]"]
    assert report["warnings"] == ["mine"]


def test_provenance_imports_nothing_heavy():
    code = (
        "import sys; from causticmpi.output.report import provenance; p = provenance('c', {}, 'h');"
        "print(sorted(set(sys.modules) & {'numba', 'llvmlite', 'mpi4py', 'embreex', 'OpenEXR', 'PIL', 'rich'}),"
        "p['versions']['numba'] is not None, p['mpi'], len(p['hosts']))"
    )
    root = Path(__file__).parent.parent
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[0] == "[] True none 1"
