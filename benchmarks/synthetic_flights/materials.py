"""Periodic, band-limited textures of the materials of a scene with depth, in each band."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import expit

from agalign.synthetic.cameras import BandSpec
from agalign.synthetic.ground import Field

_SIDE_IN_WIDTHS = 3.0
"""Texels of a tile for each pixel of the image's width. A texel is half a pixel at the nearest range, so a tile covers
nearly the whole image at twice that range.
"""
_GRAINS_TEXELS = (7.0, 18.0, 70.0)
"""Widths of the blobs of a texture: the finest one is 3.5 px at the nearest range, and has no aliasing at three times
that range with the renderer's samples."""
_ROWS_A_TILE = 14
"""Crop rows on a tile."""
_MIN_GRAIN_TEXELS = 6.0
"""Coarser noise is made on fewer texels and interpolated."""
_NIR_NM = 700.0

_LEVELS = {"concrete": (0.60, 0.48), "bench": (0.80, 0.60), "box": (1.25, 0.75), "plastic": (0.22, 0.12)}
"""Reflectance in visible bands and in near infra-red bands, as a multiple of the brighter of soil and crop, to which
the band's exposure is set."""
_CONTRAST = {"concrete": (0.25, 0.04), "bench": (0.12, 0.03), "box": (0.06, 0.30), "plastic": (0.15, 0.03)}
"""Standard deviation of the brightness, and of the print, which is dark in visible bands and bright in near infra-red
ones."""


@dataclass(frozen=True)
class Textures:
    """Noise on a square tile that repeats."""

    brightness: Field
    vigour: Field
    rows: Field
    """Share of crop."""
    waves: tuple[Field, Field]
    """Slopes of a glossy surface along u and v, of standard deviation 1."""
    texel_m: float


def make_textures(rng: np.random.Generator, texel_m: float, width_px: int) -> Textures:
    """Textures with texels of a given size, for images of a given width."""
    side = 2 ** int(np.ceil(np.log2(_SIDE_IN_WIDTHS * width_px)))
    brightness, vigour, leaves = (_octaves(rng, side) for _ in range(3))
    column = np.arange(side, dtype=np.float32) * (2 * np.pi * _ROWS_A_TILE / side)
    wobble = 0.5 * _noise(rng, side, 150.0)
    gaps = expit(4 * (_noise(rng, side, 60.0) - 1.3))
    rows = expit(4 * (np.cos(column[None, :] + wobble) + 0.7 * leaves - 0.1)) * (1 - gaps)
    height = _noise(rng, side, 30.0)
    waves = [np.gradient(height, axis=axis) for axis in (1, 0)]
    slopes = [np.asarray(w / w.std(), np.float32) for w in waves]
    return Textures(brightness, vigour, np.asarray(rows, np.float32), (slopes[0], slopes[1]), texel_m)


def reflectances(textures: Textures, band: BandSpec) -> dict[str, Field]:
    """The tile (n, n) of each material in a band: plants turn from darker than soil to brighter beyond 700 nm."""
    infrared = band.wavelength_nm > _NIR_NM
    soil = band.soil * (1 + 0.3 * textures.brightness)
    leaf = band.crop * (1 + 0.35 * (1 if infrared else -0.5) * textures.vigour)
    result = {"soil": soil, "leaf": leaf, "field": leaf * textures.rows + soil * (1 - textures.rows)}
    for name, levels in _LEVELS.items():
        brightness, printed = _CONTRAST[name]
        sign = 1 if infrared else -1
        level = levels[infrared] * max(band.soil, band.crop)
        result[name] = level * (1 + brightness * textures.brightness + sign * printed * textures.vigour)
    return {name: np.asarray(np.clip(tile, 0.002, None), np.float32) for name, tile in result.items()}


def sample(tile: Field, u_m: Field, v_m: Field, texel_m: float) -> Field:
    """A periodic tile at positions in m (height, width), no farther than some tiles from its origin."""
    x, y = (np.asarray(p * np.float32(1 / texel_m), np.float32) for p in (u_m, v_m))
    return np.asarray(cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32)


def _octaves(rng: np.random.Generator, side: int) -> Field:
    """Noise of three grains, standard deviation 1, without the rare values that would saturate a sensor."""
    parts = [weight * _noise(rng, side, grain) for weight, grain in zip((0.65, 0.6, 0.45), _GRAINS_TEXELS, strict=True)]
    return np.asarray(np.clip(sum(parts), -2.2, 2.2), np.float32)


def _noise(rng: np.random.Generator, tile_side: int, grain_texels: float) -> Field:
    """Periodic Gaussian noise of mean 0 and standard deviation 1 with blobs of the given width."""
    reduction = 2 ** max(0, int(np.log2(grain_texels / _MIN_GRAIN_TEXELS)))
    side, sigma = tile_side // reduction, grain_texels / reduction / 2
    border = int(4 * sigma) + 4
    noise = np.pad(rng.standard_normal((side, side), dtype=np.float32), border, mode="wrap")
    blurred = cv2.GaussianBlur(noise, (0, 0), sigma)
    large = cv2.resize(blurred, None, fx=reduction, fy=reduction, interpolation=cv2.INTER_CUBIC)
    field = large[border * reduction :, border * reduction :][:tile_side, :tile_side]
    return np.asarray((field - field.mean()) / field.std(), np.float32)
