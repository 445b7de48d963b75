"""Exceptions of agalign. Their text is one line with the cause and the remedy."""

import re


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
    """A file, folder or array cannot be used. The text names it and the remedy."""


class UnreadableFileError(InputError):
    """A file exists but is not a raster that can be read."""


class ConfigurationError(AgalignError):
    """Options that contradict each other or name something that does not exist."""


class NoSuchBandError(ConfigurationError):
    """No capture has a band of this name."""


class GeometryError(AgalignError):
    """A mapping cannot be inverted or estimated (singular homography, too few points)."""


class NotEnoughTextureError(AgalignError):
    """Too few keypoints are in the common area of two bands to learn from."""

    def __init__(self, keypoints: int, minimum: int) -> None:
        super().__init__(keypoints, minimum)
        self.keypoints, self.minimum = keypoints, minimum

    def __str__(self) -> str:
        return f"only {self.keypoints} keypoints are in the area that both bands show"


class NoContrastError(AgalignError):
    """No pixel of the reference has enough contrast to learn from."""

    def __str__(self) -> str:
        return "no pixel of the reference band has enough contrast to learn from"


class SidecarError(InputError):
    """A sidecar is missing or malformed, or has an unknown schema version."""


class OutputError(AgalignError):
    """A result cannot be written (no permission, disk full, a folder where a file should be)."""


class WorkerError(AgalignError):
    """The worker processes cannot be started, several end one after another, or the cluster is lost."""


class MemoryLimitError(AgalignError):
    """The system limits the memory of this process to less than the libraries need."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return True for MemoryError and for other errors with the message of a library that is out of memory."""
    messages = (
        "not enough memory|can't allocate memory|Cannot allocate memory|bad_alloc|Insufficient memory|"
        "can't start new thread|could not create a primitive|out of memory"
    )
    return isinstance(error, MemoryError) or re.search(messages, str(error)) is not None
