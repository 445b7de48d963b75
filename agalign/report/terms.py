"""The terms of the report: each is explained in the help of the page and in the tooltip of its column."""

from typing import NamedTuple


class Term(NamedTuple):
    """A word of the page and what it means."""

    word: str
    meaning: str


TERMS: dict[str, Term] = {
    "ok": Term("ok", "capture: all bands exist, from complete files, and are aligned"),
    "ok_by_prediction": Term(
        "ok by prediction",
        "capture: indices can use all bands, but at least one is predicted: its own image does not confirm it",
    ),
    "degraded": Term(
        "degraded, failed",
        "capture. degraded: a band is missing, incomplete, or too uncertain for indices. failed: all bands failed",
    ),
    "aligned": Term(
        "aligned",
        "band: its own image determines the mapping and all checks confirm it, or it shares the reference's lens",
    ),
    "predicted": Term(
        "predicted",
        "band: its image does not determine the whole mapping (water, blur, parallax seen by only two lenses). Other "
        "bands and captures predict it, or windows in a part of the image, with an expected error. Indices use it up "
        "to --accept-predicted, px of the band",
    ),
    "seed_only": Term(
        "seed only, failed, missing",
        "band that indices do not use. seed only: only the initial alignment is known. failed: no position. missing: "
        "the capture lacks the band",
    ),
    "band_pair": Term("band pair", "the reference band of a capture and one of its other bands"),
    "expected_error": Term(
        "expected error",
        "distance between a pixel of the band and the same place in the reference that is to be expected, px of the "
        "reference: root mean square over the area that both images show. It is an estimate and not a limit: errors of "
        "single pixels may be larger (heat map of expected errors, option --error-map). For a band with larger or "
        "smaller pixels, such as a thermal one, it is also given in px of the band",
    ),
    "over_1_px": Term(
        "over 1 px",
        "share of the pixels of the output whose expected error is unknown or larger than 1 px of the reference",
    ),
    "offset": Term(
        "offset before",
        "distance between the pixels of the raw files that show the same place: median over the image, px",
    ),
    "residual": Term(
        "residual",
        "shift between band and reference that windows measure after alignment, each under a mapping that was fitted "
        "without it: median and 95th percentile (p95) of its length, px; noise 0.02 to 0.05 px. It is known only where "
        "there is texture; the expected error is about the whole image. Below 0.5 px it is not visible in an index of "
        "single plants",
    ),
    "coverage": Term("windows measured", "share of the windows with texture in which a shift could be measured"),
    "seed": Term(
        "start",
        "source of the initial alignment: the model of the flight (model), the tags of the camera (rig, centre), a "
        "georeference (geo), the images (structure, match), or none (identity)",
    ),
    "geometry": Term(
        "geometry",
        "what the mapping has in addition to homography and lens models: nothing, a smooth displacement field, or the "
        "parallax of the capture (relief); with the p95 of held-out windows, px, for each that was tried",
    ),
    "occluded": Term(
        "occluded",
        "share of the pixels that the parallax hides in the band; they are nodata. The relief has one parallax per "
        "pixel, which displaces every band of the capture along its baseline",
    ),
    "retrieval": Term("retrieval", "share of held-out patches that find their counterpart in the other band"),
    "similarity": Term(
        "Mattes MI (nats), NMI, NCC, gradients, SSIM",
        "mutual information, normalized mutual information, normalized cross-correlation, correlation of gradients and "
        "structural similarity of the common area, raw files → aligned. Mattes MI is negative, as in elastix: lower is "
        "better; for the others, higher is better",
    ),
    "rig_from_bands": Term(
        "error from bands", "RMS error of the band if the other bands of the same capture predict it, px of the band"
    ),
    "rig_from_flight": Term(
        "error from flight", "RMS error of the band if only the other captures predict it, px of the band"
    ),
}
DOC_PAGES = (
    ("Read the report", "docs/how-to/report.md", "what to do, and limits for use"),
    (
        "How results are verified, and the limits",
        "docs/explanation/verification.md",
        "definitions of aligned and of the expected error",
    ),
    ("Troubleshooting", "docs/how-to/troubleshooting.md", "each reason with a remedy"),
)
"""(title, file, contents) of the pages of the documentation about the report."""
