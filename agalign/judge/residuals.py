"""How far apart the structures of two bands on one grid still lie, window by window."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from agalign.config import CheckSettings
from agalign.pixels.structure import Field, half_whitened, structure_field, tops, windowed_spectra
from agalign.values.alignment import Residual
from agalign.values.image import Mask, Raster


class FixedWindows:
    """The reference cut into windows, ready to be compared with any number of moving bands."""

    def __init__(self, valid: Mask, structure: Field, settings: CheckSettings, step_px: int | None = None) -> None:
        """`valid` and `structure` (height, width) are the reference's; `step_px` is how far apart the windows lie, by
        default side by side.
        """
        self.settings = settings
        self.valid = valid
        height, width = valid.shape
        self.side = max(32, min(settings.tile_px, width // 4, height // 4))
        origins = [(x, y) for y in _starts(height, self.side, step_px) for x in _starts(width, self.side, step_px)]
        fits = min(width, height) >= self.side
        strengths = [_strength(self._cut(structure, o)) for o in origins] if fits else []
        self.origins = [o for o, s in zip(origins, strengths, strict=False) if s >= settings.least_strength]
        self.spectra = windowed_spectra(self._windows(structure, self.origins))

    def residuals(self, moving: Raster, least_valid: float = 0.9) -> Residual:
        """The shift of each window's content; a window counts as measured where its peak stands out.

        It is looked at where this share of it is valid in both. What is not valid holds no structure, but its outline
        pulls at the shift: by some tenths of a px in windows of 64 px of which a twentieth is missing.
        """
        both = self.valid & moving.valid
        field = structure_field(moving, self.settings.smoothing_px)
        tried = [
            i for i, o in enumerate(self.origins)
            if self._cut(both, o).mean() >= least_valid
            and _strength(self._cut(field, o)) >= self.settings.least_strength
        ]  # fmt: skip
        origins = [self.origins[i] for i in tried]
        cross = half_whitened(self.spectra[tried], windowed_spectra(self._windows(field, origins)))
        found, sigma = _peaks(cross, self.settings.least_peak_sigma)
        measured = np.isfinite(found[:, 0])
        length = np.linalg.norm(found[measured], axis=1)
        some = bool(measured.any())
        return Residual(
            centres_px=np.array(origins, dtype=np.float64).reshape(-1, 2) + (self.side - 1) / 2,
            shifts_px=found,
            median_px=float(np.median(length)) if some else float("inf"),
            p95_px=float(np.percentile(length, 95)) if some else float("inf"),
            coverage=float(measured.mean()) if tried else 0.0,
            peaks_sigma=sigma,
        )

    def _cut(self, image: NDArray[Any], origin: tuple[int, int]) -> NDArray[Any]:
        x, y = origin
        return image[y : y + self.side, x : x + self.side]

    def _windows(self, field: Field, origins: list[tuple[int, int]]) -> Field:
        """(n, side, side), each without its mean: the mean orientation of a row crop is the same everywhere and tells
        no place from another.
        """
        cut = np.empty((len(origins), self.side, self.side), np.complex64)
        for window, origin in zip(cut, origins, strict=True):
            piece = self._cut(field, origin)
            np.subtract(piece, piece.mean(), out=window)
        return cut


def _strength(window: Field) -> float:
    return float(np.abs(window[::2, ::2]).mean())


def _starts(length: int, side: int, step: int | None) -> list[int]:
    count = max(1, math.ceil(length / side) if step is None else 1 + math.ceil((length - side) / step))
    return [round(v) for v in np.linspace(0, max(0, length - side), count)]


def _peaks(cross: Field, least_sigma: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """((n, 2) shifts, nan where no peak stands out; (n,) heights in standard deviations) of cross spectra."""
    count, height, width = cross.shape
    surfaces = fft.ifft2(cross).real.reshape(count, -1)
    highest = surfaces.argmax(axis=1)
    # Their means are 0: the windows have none.
    spread = np.sqrt(np.einsum("ni,ni->n", surfaces, surfaces) / (height * width))
    sigma = surfaces[np.arange(count), highest] / np.where(spread > 0, spread, np.inf)
    row, column = np.divmod(highest, width)
    # Shifts are circular: beyond half a window they are negative.
    at = np.stack([(column + width // 2) % width - width // 2, (row + height // 2) % height - height // 2], axis=1)
    found = np.full((count, 2), np.nan)
    plain = sigma >= least_sigma
    found[plain] = tops(cross[plain], at[plain].astype(np.float64))
    return found, sigma.astype(np.float64)
