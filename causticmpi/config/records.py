"""What a config file may say, as frozen records: one record per YAML section, defaults included.

The records validate themselves (types, ranges, unknown keys) when `causticmpi.config.load` converts the YAML. What a
key does stands in its record's docstring as "key: ...; key, key: ...", from which `scripts/reference.py` makes
docs/reference.md.
"""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0)]
PositiveInt = Annotated[int, Meta(ge=1)]
Count = Annotated[int, Meta(ge=0)]
Vector = tuple[float, float, float]
Method = Literal["pt", "pt-brute", "iws", "iws+pm", "iws+cf"]


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of every section: immutable, and a key that does not exist is an error."""


class Camera(Record):
    """Pinhole camera.

    eye: where it stands, in scene units; target: the point in the middle of the film, in scene units; up: direction
    that is upright in the picture, not that of the view; fov: vertical field of view in degrees.
    """

    eye: Vector
    target: Vector
    up: Vector = (0.0, 1.0, 0.0)
    fov: Annotated[float, Meta(gt=0, lt=180)] = 39.3


class Film(Record):
    """The picture.

    width, height: pixels, up to 65535; filter: samples of a pixel count alike; crop: [x0, y0, x1, y1] in pixels, half
    open, renders this part alone, at the same pixels.
    """

    width: PositiveInt = 640
    height: PositiveInt = 640
    filter: Literal["box"] = "box"
    crop: tuple[Count, Count, Count, Count] | None = None

    @property
    def window(self) -> tuple[int, int, int, int]:
        """[x0, y0, x1, y1], half open: the crop, or all of the film."""
        return self.crop or (0, 0, self.width, self.height)

    @property
    def pixels(self) -> int:
        """How many are rendered."""
        x0, y0, x1, y1 = self.window
        return (x1 - x0) * (y1 - y0)


class Budget(Record):
    """Exactly one of `time` and `spp`.

    time: wall-clock time, such as `30s`, `4min`, `1h30min`, or a number of seconds; spp: samples per pixel;
    until: estimated relMSE, such as `1%` or 0.01, at which a run stops before that (distributed.until).
    """

    time: str | float | None = None
    spp: PositiveInt | None = None
    until: str | float | None = None


class Iws(Record):
    """Illumination by Weak Singularities [CF sec. 3.1].

    paths: particle paths per pass; bound: b of the geometry term in scene units^-2, `auto`: by what the eye sees;
    deep_lights: virtual lights looked at from the second diffuse vertex on (an unbiased random subset).
    """

    paths: PositiveInt = 8
    bound: Positive | Literal["auto"] = "auto"
    deep_lights: PositiveInt = 4


class Box(Record):
    """Axis-aligned box, flat in one direction at most.

    min, max: opposite corners in scene units.
    """

    min: Vector
    max: Vector


class Forecast(Record):
    """Caustic Forecasting [CF sec. 3.2].

    sampling: `mixture` (cones, cluster directions and BRDF, balance heuristic), `two` (the paper's two tables), `one`
    (one table, empty bins filled alike), `one-cosine` (by cosine and BRDF), `one-smooth` (table spread by a Gaussian)
    or `mis` (table and BRDF, balance heuristic); clustering: vector quantization or k-means; photons: caustic points to
    collect; clusters: codewords of the clustering; neighbours: n of the gather; table: bins in azimuth and cosine, not
    for `mixture`; max_rank: clusters of a higher rank are not gathered from; splitting: samples of each table, or of
    cones, at rank 0 and diffuse depth 0; light_tracing: with `mixture`, light paths draw the caustics that the eye sees
    directly; pilot: with `mixture`, a few passes of a small picture decide how much light tracing there is, how often
    lamps are looked for, and whether the forecast pays at all (render.pilot); radius: of the gather, in scene units,
    `auto` derives it from the average photon density; overlap: the epsilon around a cluster in scene units, `auto`
    derives it likewise, not for `mixture`; aim: box towards which most photons are shot, `auto` around all specular
    surfaces where that finds them much faster, `off` for none.
    """

    sampling: Literal["mixture", "two", "one", "one-cosine", "one-smooth", "mis"] = "mixture"
    clustering: Literal["vq", "kmeans"] = "vq"
    photons: Count = 200_000
    clusters: PositiveInt = 256
    neighbours: PositiveInt = 50
    table: tuple[PositiveInt, PositiveInt] = (32, 16)
    max_rank: Count = 8
    splitting: PositiveInt = 2
    light_tracing: bool = True
    pilot: bool = True
    radius: Positive | Literal["auto"] = "auto"
    overlap: Positive | Literal["auto"] = "auto"
    aim: Literal["off", "auto"] | Box = "auto"


class PhotonMap(Record):
    """The photon map of `iws+pm`, which is biased [CF sec. 3.1].

    photons: caustic points to collect; neighbours: k of the density estimate; radius: its largest search radius in
    scene units, `auto` derives it from the points.
    """

    photons: PositiveInt = 200_000
    neighbours: Annotated[int, Meta(ge=2, description="the farthest weighs nothing")] = 50
    radius: Positive | Literal["auto"] = "auto"


class Output(Record):
    """Where the pictures go, and how often.

    directory: of pictures, report and checkpoint, relative to the current directory; interval: seconds between
    progressive pictures; checkpoint: seconds of work that may be lost, whatever happens; 0 writes no checkpoints.
    """

    directory: str = "out"
    interval: Positive = 10.0
    checkpoint: Annotated[float, Meta(ge=0)] = 60.0


class RenderConfig(Record):
    """A whole config file.

    scene: path of the scene file, relative to the config file; film: the picture; camera: instead of the scene's;
    method: `pt` (path tracing with next-event estimation), `pt-brute` (without), `iws` (L_d alone), `iws+pm` (L_c from
    a photon map, biased) or `iws+cf` (L_c by the forecast); budget: when the run ends; seed: of all random numbers;
    iws: virtual lights, for the methods `iws...`; forecast: caustics of `iws+cf`; photon_map: caustics of `iws+pm`;
    output: what is written; watertight: no ray slips between the triangles of a mesh (some 4 in 10^7 do); tracing is a
    fifth slower.
    """

    scene: str
    film: Film = Film()
    camera: Camera | None = None
    method: Method = "iws+cf"
    budget: Budget = Budget(spp=16)
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 1
    iws: Iws = Iws()
    forecast: Forecast = Forecast()
    photon_map: PhotonMap = PhotonMap()
    output: Output = Output()
    watertight: bool = False
