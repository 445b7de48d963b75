"""Evaluation of methods on pairs from several initial homographies, and tables of the results. The methods: descriptors
learned on the pair, pretrained and hand-crafted descriptors, ECC and elastix.
"""

import csv
import importlib
import importlib.util
import io
import math
import re
import time
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from statistics import fmean
from typing import get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from agalign.capture.band_pair import BandPair
from agalign.capture.reference import Reference
from agalign.capture.seeding import best_seed, image_groups
from agalign.config import JointSettings
from agalign.errors import ConfigurationError, GeometryError, InputError, NoContrastError, NotEnoughTextureError
from agalign.evaluation.ecc import homography_by_ecc
from agalign.evaluation.image_pairs import PairFiles, read_image
from agalign.flight.model import load_model
from agalign.host.files import read_regular, write_csv
from agalign.host.text import without_formula
from agalign.method.descriptor import Descriptor
from agalign.method.device import one_memory_error, one_thread
from agalign.method.fast import learn
from agalign.method.learned_matches import matching_network, sift_keypoints, to_8_bit, visible_in_both
from agalign.method.levels import make_level
from agalign.method.paper import align_by_paper, pyramid
from agalign.method.patches import Keypoints, bilinear, patch_positions, transform
from agalign.method.refine import refine
from agalign.method.state import JointState, MovingImage
from agalign.pixels.band_resampling import channel_mean, luma, warped
from agalign.pixels.landmarks import landmarks, matched_homography
from agalign.values import geometry
from agalign.values.alignment import JointResult, Seed
from agalign.values.choices import Sharing
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.mapping import PixelMapping

Describe = Callable[[Keypoints, Matrix], tuple[Tensor, Tensor]]
"""Return descriptors (f, f'), each (N, D), of the patches around keypoints of the first image, and of the patches of
the second image that a homography maps them to."""
Outcome = tuple[Describe | None, Matrix | None]
"""Descriptors and homography (fixed_to_moving) of a pair, as far as a method has them."""


@dataclass(frozen=True)
class Method:
    """A method that is evaluated."""

    apply: Callable[[Raster, Raster, Matrix], Outcome]
    """Return the outcome for two images and the initial homography, px."""
    uses_start: bool = True
    """False if the outcome does not depend on the initial homography."""
    has_homography: bool = True
    """False for a method of descriptors alone."""


RECIPES = "fast", "scratch", "paper"
"""Recipes by which descriptors are learned on a pair."""


def method_named(name: str, device: str = "auto", rng_seed: int = 0, *, seeding: bool = False) -> Method:
    """Return the method of a name on the command line.

    With `seeding`, descriptors that are learned on the pair start from the initial alignment, as in a run.

    * `fast`, `scratch` or `paper`, a colon and the sharing (`siamese`, `pseudo-siamese`, `unshared`): learned on the
      pair by that recipe. `:grey` added: on grey images.
    * `sift` (its homography is that of MAGSAC++), `daisy`, `ecc` (on gradient magnitudes), `elastix`.
    * FILE.safetensors: a network of this program. FILE.pt: a TorchScript module that takes (N, 1, P, P) in [0, 1]; P is
      32, or what follows an @, as in hardnet.pt@32.

    Raises ConfigurationError for other names, InputError for a file that cannot be used.
    """
    fixed_names: dict[str, Method] = {
        "sift": _from_patches(64, sift_of_patches, homography_by_sift),
        "daisy": _from_patches(64, daisy_of_patches),
        "ecc": Method(lambda fixed, moving, start: (None, homography_by_ecc(fixed, moving, start))),
        "elastix": Method(_elastix),
    }
    if name == "elastix" and importlib.util.find_spec("itk") is None:
        raise ConfigurationError(f"{name} needs more than is installed; in a checkout: pip install '.[evaluate]'")
    if name in fixed_names:
        return fixed_names[name]
    learned = re.fullmatch(rf"({'|'.join(RECIPES)}):([a-z-]+)(:grey)?", name)
    if learned and learned[2] in get_args(Sharing):
        facts = {"recipe": learned[1], "sharing": learned[2], "device": device, "rng_seed": rng_seed}
        settings = JointSettings.model_validate(facts)
        return Method(partial(_learned_on_pair, settings=settings, colour=learned[3] is None, seeding=seeding))
    if ".safetensors" in name:
        return _saved_network(Path(name))
    if ".pt" in name:
        file, _, side = name.partition("@")
        return _torchscript(Path(file), int(side) if side.isdigit() else 32)
    known = [*fixed_names, *(f"{recipe}:{sharing}" for recipe in RECIPES for sharing in get_args(Sharing))]
    raise ConfigurationError(f"unknown method '{name}'; choose from {', '.join(known)} or a network file")


# ---- descriptors of agalign


def _learned_on_pair(
    fixed: Raster, moving: Raster, start: Matrix, *, settings: JointSettings, colour: bool, seeding: bool
) -> Outcome:
    """Learn a descriptor and a homography on the pair."""
    if not colour or (settings.sharing == "siamese" and fixed.channels != moving.channels):
        fixed, moving = (_without_colour(r) for r in (fixed, moving))
    pair = BandPair("moving", Reference(fixed), moving, {"user": start})
    seed = best_seed(pair, pair.seed_matrices) if seeding else Seed("user", start, 0.0)
    state, [group] = JointState(settings, lambda *_: None), image_groups([pair], {pair.name: seed})
    try:
        if settings.recipe == "paper":
            net, result = align_by_paper(state, group)
        else:
            net = state.fast_descriptor([fixed.channels, moving.channels])
            learn(state, [group], net)
            result = refine(state, net, group)[0]
    except (NotEnoughTextureError, NoContrastError, GeometryError):
        return None, seed.fixed_to_moving
    mapping = (result if isinstance(result, JointResult) else group.moving[0]).fixed_to_moving
    return _by_network(net, state, fixed, moving), mapping


def _without_colour(raster: Raster) -> Raster:
    return replace(raster, pixels=luma(raster.pixels))


def _by_network(net: Descriptor, state: JointState, one: Raster, other: Raster) -> Describe:
    @torch.no_grad()
    def describe(keypoints: Keypoints, fixed_to_moving: Matrix) -> tuple[Tensor, Tensor]:
        level = make_level(state, one, [MovingImage(other, fixed_to_moving)], 1.0)
        keypoints = keypoints.to(state.device)
        return level.fixed.describe(net, keypoints), level.bands[0].describe(net, keypoints)

    return describe


def _saved_network(path: Path) -> Method:
    """Return a network of `agalign learn` or of an earlier run; images with another number of channels become grey."""
    model = load_model(path, lambda: torch.device("cpu"))

    def apply(one: Raster, other: Raster, _: Matrix) -> Outcome:
        fixed, moving = (
            r if r.channels == channels else _without_colour(r)
            for r, channels in zip((one, other), model.net.channels, strict=False)
        )
        net = matching_network(model.net, 1, (fixed.channels, moving.channels))
        state = JointState(JointSettings(device="cpu"), lambda *_: None)
        return _by_network(net, state, fixed, moving), None

    return Method(apply, uses_start=False, has_homography=False)


# ---- other methods


def _from_patches(
    side: int,
    describe_patches: Callable[[Tensor], Tensor],
    homography: Callable[[Raster, Raster], Matrix | None] | None = None,
) -> Method:
    """Return the method of a descriptor of patches (N, 1, side, side) in [0, 1], with the homography of two images."""

    def apply(fixed: Raster, moving: Raster, _: Matrix) -> Outcome:
        def describe(keypoints: Keypoints, fixed_to_moving: Matrix) -> tuple[Tensor, Tensor]:
            grid = patch_positions(keypoints, side)
            mapped = transform(torch.tensor(fixed_to_moving, dtype=torch.float32), grid)
            return describe_patches(grey_patches(fixed, grid)), describe_patches(grey_patches(moving, mapped))

        return describe, None if homography is None else homography(fixed, moving)

    return Method(apply, uses_start=False, has_homography=homography is not None)


def homography_by_sift(fixed: Raster, moving: Raster) -> Matrix | None:
    """Return fixed_to_moving of the keypoints of SIFT in the full images, as `matched_homography`."""
    one, other = (landmarks(r, "image", longest_side_px=max(r.size_px)) for r in (fixed, moving))
    return matched_homography(one, other, fixed.size_px)


def _mosaic(patches: Tensor) -> tuple[NDArray[np.float32], int, int]:
    """Return (image, its columns, side of a cell): patches (N, 1, P, P) row by row in one image for OpenCV and
    scikit-image, each padded with its edge values.
    """
    from skimage.util import montage

    margin = patches.shape[-1] // 8  # SIFT's outer cells extend beyond the edge of a patch by an eighth of its side
    padded = functional.pad(patches, [margin] * 4, mode="replicate")
    columns = max(1, math.ceil(math.sqrt(len(patches))))
    rows = max(1, math.ceil(len(patches) / columns))
    return montage(padded[:, 0].numpy(), fill=0.0, grid_shape=(rows, columns)), columns, padded.shape[-1]


def sift_of_patches(patches: Tensor) -> Tensor:
    """(N, 1, P, P) -> (N, 128): SIFT at the centre, upright, its 4 x 4 cells over the whole patch."""
    image, columns, side = _mosaic(patches)
    rows_columns = (divmod(i, columns) for i in range(len(patches)))
    centres = ((c * side + (side - 1) / 2, r * side + (side - 1) / 2) for r, c in rows_columns)
    keypoints = [cv2.KeyPoint(x, y, patches.shape[-1] / 6, 0.0, 1.0, 0) for x, y in centres]
    _, result = cv2.SIFT.create().compute(np.asarray((image * 255).round(), np.uint8), keypoints)
    return torch.from_numpy(np.asarray(result, np.float32).reshape(len(patches), -1))


def daisy_of_patches(patches: Tensor) -> Tensor:
    """(N, 1, P, P) -> (N, 200): DAISY (Tola et al. 2010) at the centre, three rings of eight over the whole patch."""
    from skimage.feature import daisy

    image, columns, side = _mosaic(patches)
    radius = patches.shape[-1] * 3 // 8  # plus the width of the outer ring: the edge of the patch
    first = side // 2 - radius
    result = daisy(image[first:, first:], step=side, radius=radius, rings=3, histograms=8, orientations=8)
    return torch.from_numpy(result[:, :columns].reshape(-1, result.shape[-1])[: len(patches)].astype(np.float32))


def _torchscript(path: Path, side: int) -> Method:
    try:
        module = torch.jit.load(str(path), map_location="cpu").eval()  # type: ignore[no-untyped-call]
        with torch.no_grad():
            module(torch.zeros(2, 1, side, side))
    except (OSError, RuntimeError, ValueError) as error:
        problem = str(error).strip().splitlines()[-1]
        raise InputError(f"{path}: not a TorchScript module of {side} x {side} patches ({problem})") from None

    @torch.no_grad()
    def describe(patches: Tensor) -> Tensor:
        return torch.cat([module(some).flatten(1) for some in torch.split(patches, 512)])

    return _from_patches(side, describe)


def _elastix(fixed: Raster, moving: Raster, start: Matrix) -> Outcome:
    """Register the pair by elastix with the number of pyramid levels of recipe paper."""
    warped_moving = warped(channel_mean(moving), PixelMapping(start), fixed.size_px)
    result = elastix_affinity(channel_mean(fixed), warped_moving, len(pyramid(max(fixed.size_px))))
    return None, None if result is None else geometry.compose(start, result)


def elastix_affinity(fixed: Raster, moving: Raster, levels: int | None = None) -> Matrix | None:
    """Return fixed_to_moving of two single-band images by elastix's affine registration with Mattes mutual information.

    None if the registration fails, for example because too many samples are outside the moving image. `levels` of the
    pyramid are elastix's default if None.
    """
    itk = importlib.import_module("itk")
    parameters = itk.ParameterObject.New()
    chosen = parameters.GetDefaultParameterMap("affine")
    if levels is not None:
        chosen["NumberOfResolutions"] = [str(levels)]
    parameters.AddParameterMap(chosen)
    images = [itk.GetImageFromArray(np.ascontiguousarray(r.pixels)) for r in (fixed, moving)]
    try:
        _, result = itk.elastix_registration_method(*images, parameter_object=parameters, log_to_console=False)
    except RuntimeError:
        return None
    table = result.GetParameterMap(0)
    a, b, c, d, x, y = map(float, table["TransformParameters"])
    centre_x, centre_y = map(float, table["CenterOfRotationPoint"])
    about_centre = np.array([[a, b, x], [c, d, y], [0.0, 0.0, 1.0]])
    to_centre, back = geometry.translation(-centre_x, -centre_y), geometry.translation(centre_x, centre_y)
    return geometry.compose(back, about_centre, to_centre)


def grey_patches(raster: Raster, grid: Tensor) -> Tensor:
    """Return grey patches (N, 1, side, side) in [0, 1] at positions (N, side, side, 2) px."""
    plane = torch.from_numpy(to_8_bit(raster).astype(np.float32) / 255)
    return bilinear(plane[None], grid)


def average_precision(f: Tensor, f_prime: Tensor) -> float:
    """Return the share of descriptors (N, D) of the first image with the corresponding descriptor as exact L2 nearest
    neighbour among those of the second (N, D); nan for N = 0.
    """
    if len(f) == 0:
        return math.nan
    nearest = torch.cat([torch.cdist(some, f_prime).argmin(dim=1) for some in torch.split(f, 512)])
    return float((nearest == torch.arange(len(f), device=f.device)).float().mean())


def homography_error_px(result: Matrix, truth: Matrix, points: NDArray[np.float64]) -> float:
    """Return the mean distance of points (N, 2) mapped by two homographies, px of the second image."""
    return float(np.linalg.norm(geometry.apply(result, points) - geometry.apply(truth, points), axis=1).mean())


# ---- evaluation


@dataclass(frozen=True)
class Starts:
    """Initial homographies: the ground truth, shifted by a share of the image's longer side."""

    shifts: tuple[float, ...] = (0.05,)
    directions: int = 1
    """Number of directions for each shift, evenly spaced from a random one for each pair."""

    def of(self, truth: Matrix, longer_side_px: int, rng: np.random.Generator) -> Iterator[tuple[float, float, Matrix]]:
        """Yield (shift, its direction in degrees, fixed_to_moving) of every initial homography."""
        first = rng.uniform(0, 2 * math.pi)
        for shift in self.shifts:
            for k in range(1 if shift == 0 else self.directions):
                angle = first + 2 * math.pi * k / self.directions
                dx, dy = shift * longer_side_px * np.array([math.cos(angle), math.sin(angle)])
                yield shift, math.degrees(angle) % 360, geometry.compose(truth, geometry.translation(dx, dy))


@dataclass(frozen=True)
class Result:
    """One method on one pair from one start."""

    pair: str
    group: str
    method: str
    shift: float
    """Shift of the initial homography as a share of the longer side."""
    direction_deg: float
    """Direction of the shift."""
    keypoints: int
    average_precision: float = math.nan
    """nan for a method without descriptors."""
    error_px: float = math.nan
    """Mean over the keypoints; inf without a result, nan for a method without a homography."""
    error_share: float = math.nan
    """`error_px` divided by the longer side of the second image."""
    seconds: float = math.nan

    @property
    def cells(self) -> list[str]:
        """The values as they are written to a table."""
        return [f"{v:.5g}" if isinstance(v, float) else str(v) for v in astuple(self)]

    @property
    def key(self) -> tuple[str, ...]:
        """Pair, method and start, as they are in a table."""
        pair, _, method, *start = map(str, map(without_formula, self.cells[:5]))
        return pair, method, *start


def evaluate(
    pairs: Sequence[PairFiles],
    methods: Mapping[str, Method],
    starts: Starts,
    rng_seed: int = 0,
    earlier: Sequence[Result] = (),
) -> Iterator[Result]:
    """Yield the results pair by pair, without the `earlier` ones; methods that do not depend on the start are run once.

    Raises InputError for a pair without a homography or an image that cannot be read.
    """
    known = Counter(result.key for result in earlier)  # pairs may have equal names
    for pair in pairs:
        truth = pair.fixed_to_moving
        if truth is None:
            raise InputError(f"{pair.fixed}: has no homography to compare with")
        fixed, moving = read_image(pair.fixed), read_image(pair.moving)
        keypoints = visible_in_both(sift_keypoints(fixed), truth, fixed, moving)
        points_px = keypoints.xy.numpy().astype(np.float64)
        for name, method in methods.items():
            rng = np.random.default_rng((rng_seed, zlib.crc32(pair.name.encode())))
            of_pair = starts.of(truth, max(fixed.size_px), rng)
            for shift, direction_deg, start in of_pair if method.uses_start else islice(of_pair, 1):
                empty = Result(pair.name, pair.group, name, shift, direction_deg, len(keypoints))
                if known[empty.key]:
                    known[empty.key] -= 1
                    continue
                began = time.perf_counter()
                with one_thread(), one_memory_error():
                    describe, result = method.apply(fixed, moving, start)
                seconds = time.perf_counter() - began
                precision = error_px = math.nan
                if describe is not None and len(keypoints):
                    precision = average_precision(*describe(keypoints, truth))
                if method.has_homography and len(keypoints):
                    error_px = math.inf if result is None else homography_error_px(result, truth, points_px)
                share = error_px / max(moving.size_px)
                yield replace(empty, average_precision=precision, error_px=error_px, error_share=share, seconds=seconds)


_COLUMNS = [f.name for f in fields(Result)]


def read_results(path: Path) -> list[Result]:
    """Return the results in a table of an earlier evaluation, without a line that was not written to its end; none if
    the file does not exist. Raises ConfigurationError for another file.
    """
    try:
        text = read_regular(path).decode()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read ({error}); choose another name with -o") from None
    try:
        header, *rows = csv.reader(io.StringIO(text[: text.rfind("\n") + 1]))
        if header != _COLUMNS:
            raise ValueError
        kinds = [f.type for f in fields(Result)]
        return [Result(*(kind(cell) for kind, cell in zip(kinds, row, strict=True))) for row in rows]  # type: ignore[operator]
    except ValueError:
        raise ConfigurationError(f"{path}: is not a table of this version; choose another name with -o") from None


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Write the results as CSV, one row per result. Raises OutputError."""
    write_csv(path, _COLUMNS, (result.cells for result in results))


def precision_table(results: Sequence[Result]) -> list[list[str]]:
    """Mean average precision: a row of titles, then a row for each method with a column for each group."""
    described = [r for r in results if not math.isnan(r.average_precision)]
    groups = list(dict.fromkeys(r.group for r in results))
    totals = ["all"] if len(groups) > 1 else []
    rows = [["method", *groups, *totals, "pairs"]]
    for method in dict.fromkeys(r.method for r in described):
        own = [r for r in described if r.method == method]
        means = [_mean_precision([r for r in own if r.group == group]) for group in groups]
        means += [_mean_precision(own) for _ in totals]
        rows.append([method, *(f"{m:.3f}" for m in means), str(len({r.pair for r in own}))])
    return rows


def error_table(results: Sequence[Result]) -> list[list[str]]:
    """Errors of the homographies: a row of titles, then a row for each method and shift."""
    rows = [
        ["method", "start off by", "median error, px", "worst, px", "mean, % of the side", "under 1 px", "mAP", "s"]
    ]
    measured = [r for r in results if not math.isnan(r.error_px)]
    for method, shift in product(*(dict.fromkeys(getattr(r, name) for r in results) for name in ("method", "shift"))):
        own = [r for r in measured if (r.method, r.shift) == (method, shift)]
        if own:
            e, shares, seconds = np.array([(r.error_px, r.error_share, r.seconds) for r in own]).T
            errors = f"{np.median(e):.3f}", f"{e.max():.2f}", f"{shares.mean():.3%}", f"{(e < 1).sum()} of {len(e)}"
            rows.append([method, f"{shift:.1%}", *errors, f"{_mean_precision(own):.3f}", f"{np.median(seconds):.1f}"])
    return rows


def _mean_precision(results: Sequence[Result]) -> float:
    """Return the mean of the average precisions; nan without results."""
    return fmean(r.average_precision for r in results) if results else math.nan
