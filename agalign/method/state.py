"""Inputs of a joint optimisation: the images of a capture, settings and random numbers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch

from agalign.config import JointSettings
from agalign.errors import NoContrastError
from agalign.method.descriptor import Descriptor
from agalign.method.device import choose_device
from agalign.method.levels import Level, Sampler, make_level
from agalign.method.starter import start_from_starter
from agalign.values.alignment import DisplacementField
from agalign.values.geometry import Matrix
from agalign.values.image import Raster

Progress = Callable[[str, float], None]
"""Called with the name of a stage and the share of it that is done, 0 to 1."""
ThetaStart = Literal["starter", "random"]


@dataclass
class ImageGroup:
    """The images of one capture and the current state of their alignment."""

    fixed: Raster
    moving: Sequence[Raster]
    mappings: list[Matrix]
    """fixed_to_moving of each moving image, undistorted px; moved along by the optimisation."""
    sides: Sequence[int]
    """The side of the network that describes each moving image."""
    trusted: Sequence[bool]
    """True for a seed that is good to a few pixels: recipe fast then skips the coarse levels."""
    reach_px: Sequence[float] = ()
    """Largest distance of each result from its mapping, px of `fixed`; empty if unlimited."""
    dropped: dict[int, float] = field(default_factory=dict)
    """{moving image: held-out retrieval} where the descriptors could not distinguish patches at some level: they are
    neither learnt nor refined any more."""
    fields: Sequence[DisplacementField | None] = ()
    """Displacements of the reference's positions before each homography, px of `fixed`; empty for none at all."""

    @property
    def active(self) -> list[int]:
        """The moving images that are not dropped."""
        return [b for b in range(len(self.moving)) if b not in self.dropped]

    @classmethod
    def of_one(cls, fixed: Raster, moving: Raster, fixed_to_moving: Matrix, *, trusted: bool = False) -> "ImageGroup":
        """A single pair, described by the network's first two sides."""
        return cls(fixed, [moving], [fixed_to_moving], [1], [trusted])


class JointState:
    """What both recipes share: settings, device and random numbers. Raises ConfigurationError for an unknown device."""

    def __init__(self, settings: JointSettings, progress: Progress) -> None:
        self.settings = settings
        self.progress = progress
        self.device = choose_device(settings.device)
        self.sampler = Sampler(torch.Generator().manual_seed(settings.rng_seed))
        self.family = None if settings.model_family == "auto" else settings.model_family

    def level(self, group: ImageGroup, scale: float, bands: Sequence[int]) -> Level:
        """The reference of a group and some of its moving images at a resolution. Raises NoContrastError."""
        level = make_level(
            group.fixed, [group.moving[b] for b in bands], [group.mappings[b] for b in bands], scale,
            self.sampler.generator, self.device,
        )  # fmt: skip
        if group.fields:
            level = level.with_fields([group.fields[b] for b in bands])
        if len(level.trainable) == 0:
            raise NoContrastError
        return level

    def paper_descriptor(self, channels: Sequence[int]) -> Descriptor:
        """F of recipe paper with random weights; `channels` of each side, the reference's first."""
        return self._random_descriptor(channels, half_rectified=False, unit_length=False)

    def fast_descriptor(self, channels: Sequence[int], start: ThetaStart = "starter") -> Descriptor:
        """F of recipe fast where theta starts: with the network that comes with the package, or with random weights."""
        net = self._random_descriptor(channels, half_rectified=True, unit_length=True)
        if start == "starter":
            start_from_starter(net)
        return net

    def _random_descriptor(self, channels: Sequence[int], *, half_rectified: bool, unit_length: bool) -> Descriptor:
        """Its weights depend only on the rng_seed of the settings."""
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(self.settings.rng_seed)
            net = Descriptor(self.settings.sharing, channels, half_rectified=half_rectified, unit_length=unit_length)
        return net.to(self.device)
