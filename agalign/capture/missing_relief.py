"""The error of homographies by the relief that they lack, in images without common structure in one part: there, no
residual of windows contains it.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from agalign.capture.band_pair import BandPair
from agalign.capture.candidate import Candidate
from agalign.values import geometry
from agalign.values.geometry import Matrix
from agalign.values.issues import INACCURATE
from agalign.verify.coverage import points_in_frame, unobserved_quarters

_RELIEF_SHARE = 0.15
"""Standard deviation of the relief of ground without common structure, as a share of its range: crops and trees at low
altitude, plants and booms at a metre."""


def is_extrapolated(candidate: Candidate) -> bool:
    """Return True for a mapping that is only inaccurate, without windows in a quarter of the image."""
    pair = candidate.pair
    if [issue.kind for issue in candidate.issues] != [INACCURATE]:
        return False
    in_frame_px = points_in_frame(candidate.mapping, *pair.sizes_px)
    unobserved = unobserved_quarters(candidate.residual.measured_px, pair.fixed.size_px, in_frame_px)
    return not pair.is_georeferenced and bool(unobserved)


def spreads_of_relief_px(pairs: Sequence[BandPair], homographies: Mapping[str, Matrix]) -> dict[str, float]:
    """Return the spread of the relief that the homographies between the images lack, by band, px of the fixed image.

    It is that of the flight, or that of unknown relief at the range of the capture, if this is larger. The rig tags
    contain the mappings at infinity. Their errors have no common direction: the shift of the scene from infinity is the
    part of the bands' differences from the tags that is proportional to the layout of the lenses.
    """
    layouts, offsets_px = dict[str, np.ndarray](), []
    for pair in pairs:
        if pair.layout is None or "rig" not in pair.seed_matrices or pair.name not in homographies:
            continue
        centre = (np.array(pair.fixed.size_px) - 1) / 2
        from_infinity = geometry.compose(geometry.invert(pair.seed_matrices["rig"]), homographies[pair.name])
        layouts[pair.name] = np.array(pair.layout)
        offsets_px.append((geometry.apply(from_infinity, centre) - centre) / pair.scales.fixed.mean)
    along, known = np.ravel(offsets_px), np.ravel(list(layouts.values()))
    common_px = max(0.0, float(along @ known)) / max(float(known @ known), 1e-12)

    def spread_px(pair: BandPair) -> float:
        if pair.name not in layouts:
            return pair.relief_std_px
        shift_px = common_px * float(np.linalg.norm(layouts[pair.name])) * pair.scales.fixed.mean
        return max(pair.relief_std_px, _RELIEF_SHARE * shift_px)

    return {pair.name: spread_px(pair) for pair in pairs}
