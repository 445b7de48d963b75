"""Map pixels of the reference to a band by the sidecar, without agalign: a reader to copy into other programs.

python examples/map_pixels.py SIDECAR BAND X Y [PARALLAX]

Pixels are raw: x right, y down, (0, 0) is the centre of the top-left pixel. PARALLAX (px) is that of the pixel if the
band has a `relief`: the first layer of <capture>.parallax.tif times its scale (raster.read(1) * raster.scales[0]).
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline


def mapped(band: dict, points_px: np.ndarray, parallax_px: np.ndarray | float = 0.0) -> np.ndarray:
    """Map raw pixels (..., 2) of the reference, with the parallax (...) there, to raw pixels, to 0.02 px."""
    if band["status"] == "reference":
        return points_px
    part = band["relief"] or band["grid"]
    nodes = np.array(part["reference_px"])
    x, y = np.unique(nodes[:, 0]), np.unique(nodes[:, 1])
    z, result = np.asarray(parallax_px)[..., None], 0.0
    for power, name in enumerate(("plane_px", "slope", "curvature") if band["relief"] else ("moving_px",)):
        if part[name] is None:  # no curvature
            continue
        columns = np.reshape(part[name], (len(y), len(x), 2)).transpose(2, 0, 1)
        splines = [RectBivariateSpline(y, x, values) for values in columns]
        at_points = np.stack([s.ev(points_px[..., 1], points_px[..., 0]) for s in splines], axis=-1)
        result = result + z**power * at_points
    return result


if __name__ == "__main__":
    if len(sys.argv) not in (5, 6):
        sys.exit("usage: python examples/map_pixels.py SIDECAR BAND X Y [PARALLAX]")
    path, name, *numbers = sys.argv[1:]
    bands = {band["band"]: band for band in json.loads(Path(path).read_text(encoding="utf-8"))["bands"]}
    point, parallax = np.array(numbers[:2], float), float(numbers[2]) if len(numbers) == 3 else 0.0
    print(f"{name}: {mapped(bands[name], point, parallax).round(3).tolist()}")
