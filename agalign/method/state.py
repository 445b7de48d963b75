"""Inputs of a joint optimisation: the images of a capture, settings, device and random generator."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from agalign.config import JointSettings
from agalign.errors import NoContrastError
from agalign.method.descriptor import Descriptor, start_from, start_from_starter
from agalign.method.device import choose_device
from agalign.method.levels import Level, Sampler, make_level
from agalign.values.geometry import Matrix
from agalign.values.image import Raster
from agalign.values.mapping import DisplacementField

Progress = Callable[[str, float], None]
"""Called with the name of a stage and its completed share, 0 to 1."""


@dataclass
class ImageGroup:
    """The images of one capture and the current state of their alignment."""

    fixed: Raster
    moving: Sequence[Raster]
    mappings: list[Matrix]
    """fixed_to_moving of each moving image, undistorted px; the optimisation updates them."""
    sides: Sequence[int]
    """Side of the network that describes each moving image."""
    trusted: Sequence[bool]
    """True for seeds with an error of a few pixels, for which recipe fast skips the coarse levels."""
    max_shift_px: Sequence[float] = ()
    """Maximum shift from each mapping in the search at the coarsest level, px of `fixed`; empty for no limit."""
    dropped: dict[int, float] = field(default_factory=dict)
    """Held-out retrieval of the moving images (by index) that the descriptors cannot distinguish at some level. They
    are neither trained on nor refined further."""
    fields: Sequence[DisplacementField | None] = ()
    """Displacement of positions of the reference before each homography, px of `fixed`; empty for none."""

    @property
    def active(self) -> list[int]:
        """Indices of the moving images that are not dropped."""
        return [b for b in range(len(self.moving)) if b not in self.dropped]

    @classmethod
    def of_one(cls, fixed: Raster, moving: Raster, fixed_to_moving: Matrix, *, trusted: bool = False) -> "ImageGroup":
        """Create the group of one image pair; sides 0 and 1 of the network describe it."""
        return cls(fixed, [moving], [fixed_to_moving], [1], [trusted])


class JointState:
    """Settings, device and random generator of one optimisation.

    Raises ConfigurationError for a device that cannot be used.
    """

    def __init__(self, settings: JointSettings, progress: Progress) -> None:
        self.settings = settings
        self.progress = progress
        self.device = choose_device(settings.device)
        self.sampler = Sampler(torch.Generator().manual_seed(settings.rng_seed))
        self.family = None if settings.model_family == "auto" else settings.model_family

    def level(self, group: ImageGroup, scale: float, bands: Sequence[int]) -> Level:
        """Build the level of the reference and some moving images at `scale`. Raises NoContrastError."""
        moving, mappings = [group.moving[b] for b in bands], [group.mappings[b] for b in bands]
        level = make_level(group.fixed, moving, mappings, scale, self.sampler.generator, self.device)
        if group.fields:
            level = level.with_fields([group.fields[b] for b in bands])
        if len(level.trainable) == 0:
            raise NoContrastError
        return level

    def paper_descriptor(self, channels: Sequence[int]) -> Descriptor:
        """Create the network of recipe paper with random weights; `channels` per side, the reference first."""
        return self._random_descriptor(channels, half_rectified=False, unit_length=False)

    def fast_descriptor(self, channels: Sequence[int]) -> Descriptor:
        """Create the network of recipe fast with the weights in the package, of recipe scratch with random ones.

        They are equal for all sides. Half of the filters ignore the sign of the contrast, so the responses of equal
        random filters are similar where bands show the same: enough to search the first translation with them.
        """
        net = self._random_descriptor(channels, half_rectified=True, unit_length=True)
        if self.settings.recipe == "scratch":
            start_from(net, self._random_descriptor([1], half_rectified=True, unit_length=True).state_dict())
        else:
            start_from_starter(net)
        return net

    def _random_descriptor(self, channels: Sequence[int], *, half_rectified: bool, unit_length: bool) -> Descriptor:
        """Create a network with weights that depend only on the rng_seed of the settings."""
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(self.settings.rng_seed)
            net = Descriptor(self.settings.sharing, channels, half_rectified=half_rectified, unit_length=unit_length)
        return net.to(self.device)
