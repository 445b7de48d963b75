"""Write warp matrices of an aligned capture for MicaSense's notebooks, and print those between raw pixels for OpenCV.

python examples/warp_matrices.py ALIGNED/0000SET/000/IMG_0001.json

The file SERIAL_warp_matrices_opencv.npy is for `micasense.imageutils.aligned_capture` with `cv2.MOTION_HOMOGRAPHY`: the
alignment notebook loads it from its own folder for cameras without a panchromatic band. Its match index is that of the
reference among the bands. For OpenCV:

    cv2.warpPerspective(nir, matrices["NIR"], size_px, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

if len(sys.argv) != 2:
    sys.exit("usage: python examples/warp_matrices.py SIDECAR")
sidecar = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
if sidecar["status"] != "ok":
    sys.exit(f"{sys.argv[1]}: its status is {sidecar['status']}; choose a capture with status ok")
size_px = sidecar["reference"]["width"], sidecar["reference"]["height"]
bands = sorted(sidecar["bands"], key=lambda band: (len(band["file"]), band["file"]))
if any(band["grid"] is not None and band["lenses"] is None for band in bands):
    sys.exit(f"{sys.argv[1]}: has no lenses; MicaSense's notebooks need the tags of a MicaSense camera")


def undistorted(points, lens, size_px):
    """Return raw pixels in the image that `micasense.image.Image.undistorted` makes."""
    camera = np.array([[lens["fx_px"], 0, lens["cx_px"]], [0, lens["fy_px"], lens["cy_px"]], [0, 0, 1]])
    distortion = np.array(lens["distortion"])
    new_camera, _ = cv2.getOptimalNewCameraMatrix(camera, distortion, size_px, 1)
    return cv2.undistortPoints(points[:, None], camera, distortion, P=new_camera)[:, 0]


matrices, warp_matrices = {}, []  # between raw pixels, by band; between undistorted pixels
for band in bands:
    matrices[band["band"]] = matrix = np.eye(3)
    if band["grid"] is not None:  # else it is the reference
        reference_px, moving_px = (np.array(band["grid"][name]) for name in ("reference_px", "moving_px"))
        matrices[band["band"]], _ = cv2.findHomography(reference_px, moving_px)
        lens, moving_lens = band["lenses"]
        straight, moved = undistorted(reference_px, lens, size_px), undistorted(moving_px, moving_lens, band["size_px"])
        matrix, _ = cv2.findHomography(straight, moved)
    warp_matrices.append(matrix.astype("float32"))
target = f"{sidecar['camera']['serial']}_warp_matrices_opencv.npy"
np.save(target, warp_matrices)
print(f"{target}: {len(warp_matrices)} bands")
for name, matrix in matrices.items():
    print(name, *np.round(matrix, 6).tolist())
