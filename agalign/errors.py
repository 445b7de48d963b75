"""Exceptions of agalign. Their text is one line with the cause and the remedy."""

import re
from typing import NamedTuple


class Reason(NamedTuple):
    """What is wrong with a file, and what to do about it; as text, both on one line."""

    what: str
    remedy: str = ""

    def __str__(self) -> str:
        return "; ".join(filter(None, self))


class AgalignError(Exception):
    """Base of the exceptions of agalign. The text is one line with the cause and the remedy.

    Examples
    --------
    >>> try:
    ...     agalign.discover("no/such/folder")
    ... except agalign.AgalignError as error:
    ...     print(error)
    no/such/folder: does not exist; give the folder of the images
    """


class InputError(AgalignError):
    """A file, folder or array cannot be used. The text names it and the remedy.

    Examples
    --------
    >>> try:
    ...     agalign.align(np.zeros((40, 40)), np.zeros((40, 40)))
    ... except agalign.InputError as error:
    ...     print(error)
    fixed is (40, 40): images need 48 px a side
    """


class UnreadableFileError(InputError):
    """A file does not exist, or is not a raster that can be read.

    Examples
    --------
    >>> try:
    ...     agalign.onto("june.tif", ["august.tif"], "august_on_june")
    ... except agalign.UnreadableFileError as error:
    ...     print(error.reason.what)
    august.tif: does not exist
    """

    @property
    def reason(self) -> Reason:
        """What is wrong with the file, and the remedy."""
        return Reason(*self.args)

    def __str__(self) -> str:
        return str(self.reason)


class ConfigurationError(AgalignError):
    """Options that contradict each other or name something that does not exist.

    Examples
    --------
    >>> try:
    ...     agalign.indices("aligned", formulas=["mine=N-X"])
    ... except agalign.ConfigurationError as error:
    ...     print(error)
    index 'mine', N-X, uses X; the bands are B, G, R, RE and N
    """


class NoSuchBandError(ConfigurationError):
    """No capture has a band of this name.

    Examples
    --------
    >>> try:
    ...     agalign.read_alignment("aligned/0000SET/000/IMG_0001.json", "Thermal")
    ... except agalign.NoSuchBandError as error:
    ...     print(error)
    aligned/0000SET/000/IMG_0001.json: no moving band 'Thermal'; choose from Blue, Red, NIR, Red edge
    """


class GeometryError(AgalignError):
    """A mapping cannot be inverted or estimated (singular homography, too few points).

    Examples
    --------
    >>> image = np.zeros((64, 64))
    >>> try:
    ...     agalign.warp_onto(image, np.zeros((3, 3)), (64, 64))
    ... except agalign.GeometryError as error:
    ...     print(error)
    the homography is singular: [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """


class NotEnoughTextureError(AgalignError):
    """Too few keypoints are in the common area of two bands to learn from.

    The public functions do not raise it: they report this reason for the band, which is not aligned.

    Parameters
    ----------
    keypoints
        Number of keypoints in the common area.
    minimum
        Number that is needed.

    Examples
    --------
    >>> print(agalign.NotEnoughTextureError(keypoints=12, minimum=64))
    only 12 keypoints are in the area that both bands show
    """

    def __init__(self, keypoints: int, minimum: int) -> None:
        super().__init__(keypoints, minimum)
        self.keypoints, self.minimum = keypoints, minimum

    def __str__(self) -> str:
        return f"only {self.keypoints} keypoints are in the area that both bands show"


class NoContrastError(AgalignError):
    """No valid patch of the reference has enough contrast to learn from.

    The public functions do not raise it: they report this reason for the bands, which are not aligned.

    Examples
    --------
    >>> print(agalign.NoContrastError())
    no valid patch of the reference has enough contrast to learn from
    """

    def __str__(self) -> str:
        return "no valid patch of the reference has enough contrast to learn from"


class SidecarError(InputError):
    """A sidecar is missing or malformed, or has an unknown schema version.

    Examples
    --------
    >>> try:
    ...     agalign.read_alignment("aligned/IMG_0009.json", "NIR")
    ... except agalign.SidecarError as error:
    ...     print(error)
    aligned/IMG_0009.json: does not exist; give the sidecar of a capture
    """


class OutputError(AgalignError):
    """A result cannot be written (no permission, disk full, a folder where a file should be).

    Examples
    --------
    >>> try:
    ...     agalign.export("aligned", "flight", "odm")
    ... except agalign.OutputError as error:
    ...     print(error)
    flight: is not empty; choose another folder with -o, or delete it
    """


class WorkerError(AgalignError):
    """The worker processes cannot be started, several end one after another, or the cluster is lost.

    Examples
    --------
    `settings` is that of the example of `align_folder`.

    >>> try:
    ...     reports = agalign.align_folder("flight", "aligned", settings=settings, run=agalign.RunOptions(jobs=2))
    ... except agalign.WorkerError:  # continue with one process; the finished captures are kept
    ...     reports = agalign.align_folder("flight", "aligned", settings=settings)
    >>> len(reports)
    2
    """


def is_out_of_memory(error: BaseException) -> bool:
    """Return True for MemoryError and for other errors with the message of a library that is out of memory."""
    messages = (
        "not enough memory|can't allocate memory|Cannot allocate memory|bad_alloc|Insufficient memory|"
        "can't start new thread|could not create a primitive|out of memory"
    )
    return isinstance(error, MemoryError) or re.search(messages, str(error)) is not None
