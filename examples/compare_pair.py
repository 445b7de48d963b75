"""Compare agalign, SIFT and ECC on one pair of images; with known tie points, print the errors of each.

python examples/compare_pair.py FIXED MOVING [TIES.csv [HOMOGRAPHY.txt]]

TIES.csv has the columns fixed_x, fixed_y, moving_x, moving_y: raw pixels, x right, y down, (0, 0) is the centre of the
top-left pixel. Without it, the script prints how far each method is from agalign. HOMOGRAPHY.txt has 3 x 3 numbers: the
mapping from FIXED to MOVING by another method. FIXED and MOVING have one band each. agalign accepts a pair with the
status `aligned`; one that is `failed` has no mapping.
"""

import sys

import cv2
import numpy as np

import agalign


def by_sift(fixed, moving):
    """Return the homography (3, 3) of MAGSAC++ from SIFT matches, or None."""
    sift = cv2.SIFT.create(5000, enable_precise_upscale=True)  # without it, key points are off by 0.25 px
    (points, found), (others, theirs) = (sift.detectAndCompute(image, None) for image in (fixed, moving))
    if found is None or theirs is None:  # no key point
        return None
    matches = cv2.BFMatcher().knnMatch(found, theirs, k=2)
    good = [match[0] for match in matches if len(match) == 2 and match[0].distance < 0.8 * match[1].distance]
    if len(good) < 4:
        return None
    source, target = [points[m.queryIdx].pt for m in good], [others[m.trainIdx].pt for m in good]
    return cv2.findHomography(np.array(source), np.array(target), cv2.USAC_MAGSAC, 2.0, None, 10_000, 0.9999)[0]


def by_ecc(fixed, moving):
    """Return the homography (3, 3) of ECC on gradient magnitudes, from the identity over a pyramid, or None."""
    smooth = [cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0) for image in (fixed, moving)]
    edges = [cv2.magnitude(cv2.Sobel(s, cv2.CV_32F, 1, 0), cv2.Sobel(s, cv2.CV_32F, 0, 1)) for s in smooth]
    matrix, criteria = np.eye(3), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    for scale in (1 / 8, 1 / 4, 1 / 2, 1):
        small = [cv2.resize(e, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for e in edges]
        shift = scale / 2 - 0.5  # (0, 0) is the centre of the top-left pixel
        to_small = np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])
        start = (to_small @ matrix @ np.linalg.inv(to_small)).astype(np.float32)
        try:
            _, result = cv2.findTransformECC(*small, start, cv2.MOTION_HOMOGRAPHY, criteria, None, 1)
        except cv2.error:  # it does not converge
            return None
        matrix = np.linalg.inv(to_small) @ result @ to_small
    return matrix


if len(sys.argv) not in (3, 4, 5):
    sys.exit("usage: python examples/compare_pair.py FIXED MOVING [TIES.csv [HOMOGRAPHY.txt]]")
fixed, moving = (cv2.imread(name, cv2.IMREAD_UNCHANGED) for name in sys.argv[1:3])
grey = [cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U) for image in (fixed, moving)]
result = agalign.align(fixed, moving)
if result.status == "failed":
    print(f"agalign, failed: {result.reason}")
    if len(sys.argv) == 3:
        sys.exit("nothing to compare with; give TIES.csv")
matrices = {"SIFT": by_sift(*grey), "ECC": by_ecc(*grey)}

if len(sys.argv) == 5:
    matrices["the homography"] = np.loadtxt(sys.argv[4])
if len(sys.argv) >= 4:
    ties = np.loadtxt(sys.argv[3], delimiter=",", skiprows=1)
    points, truth, what = ties[:, :2], ties[:, 2:], "error"
else:
    x, y = np.meshgrid(np.linspace(0, fixed.shape[1] - 1, 33), np.linspace(0, fixed.shape[0] - 1, 25))
    points = np.column_stack([x.ravel(), y.ravel()])
    truth, what = result.map(points), "distance from agalign"
mapped = {} if result.status == "failed" else {f"agalign, {result.status}": result.map(points)}
for name, matrix in matrices.items():
    mapped[name] = None if matrix is None else cv2.perspectiveTransform(points[None], matrix)[0]
for name, positions in mapped.items():
    if positions is None:
        print(f"{name}: no mapping")
        continue
    error_px = np.linalg.norm(positions - truth, axis=1)
    print(f"{name}: median {what} {np.median(error_px):.3f} px, beyond 1 px {np.mean(error_px > 1):.1%}")
if result.status in ("aligned", "predicted"):
    print(f"expected error by agalign: {result.std_px:.3f} px (RMS)")
