"""The method: learn a descriptor on the very images to be aligned while the homographies are optimised (paper, Sec. 4).

    argmin over theta and psi of   sum L0(x, w(x; psi); theta) + sum L1(x, x'; theta)

theta are the weights of the descriptor f, psi the parameters of the homography w from I (`fixed`) to I' (`moving`),
L0 the distance of two matching descriptors and L1 the hinge on the others. Two recipes do this on the
same levels, keypoints, patches and networks:

* `paper` (`paper.descend`): SGD on theta and psi together, coarse to fine, one pair at a time, as published.
* `fast` (`fast.learn`, then `refine.refine`): Adam on theta through in-batch negatives; every few steps one
  Gauss-Newton step on psi minimises L0 squared; at full resolution psi alone, theta frozen.

Where theta is known already, from the flight, only psi is optimised (`refine_with`).
"""

from dataclasses import replace

from agalign.config import JointSettings
from agalign.errors import GeometryError, NoContrastError, NotEnoughTextureError
from agalign.method.descriptor import Descriptor
from agalign.method.fast import DEFAULT_SCHEDULE, Schedule, learn
from agalign.method.paper import DEFAULT_TRAINING, Training, align_by_paper
from agalign.method.refine import PATCHES, refine
from agalign.method.state import ImageGroup, JointState, Progress, ThetaStart
from agalign.values.alignment import JointResult
from agalign.values.issues import FEW_KEYPOINTS, NO_CONTRAST, NOT_INVERTIBLE, Issue
from agalign.values.pixel_units import FixedImagePx

Results = list[JointResult[FixedImagePx] | Issue]
"""For each moving image of a group the result, or the reason why there is none."""


def align_from_scratch(
    group: ImageGroup, settings: JointSettings, progress: Progress, *, start: ThetaStart = "starter",
    schedule: Schedule = DEFAULT_SCHEDULE, training: Training = DEFAULT_TRAINING,
) -> Results:  # fmt: skip
    """Theta and every psi of one capture by itself.

    `start` and `schedule` are recipe fast's, `training` is recipe paper's. Raises ConfigurationError where there is no
    such device.
    """
    state = JointState(settings, progress)
    if settings.recipe == "paper":
        return [_by_paper(state, group, b, training) for b in range(len(group.moving))]
    net = state.fast_descriptor([r.channels for r in (group.fixed, *group.moving)], start)
    try:
        steps, loss = learn(state, [group], net, schedule=schedule)
        results = refine(state, net, group)
    except NoContrastError:
        return [Issue(NO_CONTRAST)] * len(group.moving)
    return [r if isinstance(r, Issue) else replace(r, loss=loss, iterations=steps) for r in results]


def refine_with(
    net: Descriptor, group: ImageGroup, settings: JointSettings, progress: Progress, patches: int = PATCHES
) -> Results:
    """Every psi of a capture with the flight's theta frozen."""
    try:
        results = refine(JointState(settings, progress), net, group, patches=patches)
    except NoContrastError:
        return [Issue(NO_CONTRAST)] * len(group.moving)
    return [r if isinstance(r, Issue) else replace(r, recipe="flight") for r in results]


def _by_paper(state: JointState, group: ImageGroup, band: int, training: Training) -> JointResult[FixedImagePx] | Issue:
    one = ImageGroup.of_one(group.fixed, group.moving[band], group.mappings[band])
    try:
        return align_by_paper(state, one, training)[1]
    except NotEnoughTextureError as why_not:
        return Issue(FEW_KEYPOINTS, why_not.keypoints, why_not.minimum)
    except NoContrastError:
        return Issue(NO_CONTRAST)
    except GeometryError:
        return Issue(NOT_INVERTIBLE)
