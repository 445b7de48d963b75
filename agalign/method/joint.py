"""The method: learn a descriptor on the images to be aligned while the homographies are optimised (paper, Sec. 4).

    argmin over theta and psi of   sum L0(x, w(x; psi); theta) + sum L1(x, x'; theta)

theta are the weights of the descriptor f, psi the parameters of the homography w from I (`fixed`) to I' (`moving`),
L0 is the distance of two matching descriptors, L1 the hinge loss of non-matching ones. The recipes share levels,
keypoints, patches and networks:

* `paper` (`paper.descend`): SGD on theta and psi together, coarse to fine, one pair at a time, as published.
* `fast` (`fast.learn`, then `refine.refine`): Adam on theta with in-batch negatives; every few steps, one
  Gauss-Newton step on psi (`gauss_newton.solve`: a homography, affine mapping or translation) minimises L0 squared.
  At full resolution theta is frozen and only psi is optimised.
* `scratch`: the same from random weights.

With the network of a flight, theta is frozen throughout (`refine_with`).
"""

from dataclasses import replace

from agalign.config import JointSettings
from agalign.errors import GeometryError, NoContrastError, NotEnoughTextureError
from agalign.method.descriptor import Descriptor
from agalign.method.fast import Schedule, learn
from agalign.method.paper import DEFAULT_TRAINING, Training, align_by_paper
from agalign.method.refine import PATCHES, refine
from agalign.method.state import ImageGroup, JointState, MovingImage, Progress
from agalign.values.alignment import JointResult
from agalign.values.issues import FEW_KEYPOINTS, NO_CONTRAST, NOT_INVERTIBLE, Issue

Results = dict[str, JointResult | Issue]
"""The result for each moving image by its name, or the reason why there is none."""


def learn_and_refine(
    group: ImageGroup,
    settings: JointSettings,
    progress: Progress,
    *,
    schedule: Schedule | None = None,
    training: Training = DEFAULT_TRAINING,
) -> Results:
    """Optimise theta and every psi for one capture alone.

    Only recipe paper uses `training`, and the others `schedule`, by default that of the recipe. Raises
    ConfigurationError for a device that cannot be used.
    """
    state = JointState(settings, progress)
    if settings.recipe == "paper":
        pairs = {m.name: ImageGroup(group.fixed, [MovingImage(m.raster, m.fixed_to_moving)]) for m in group.moving}
        return {name: _by_paper(state, pair, training) for name, pair in pairs.items()}
    net = state.fast_descriptor([group.fixed.channels, *(moving.raster.channels for moving in group.moving)])
    try:
        steps, loss = learn(state, [group], net, schedule=schedule)
        results = refine(state, net, group)
    except NoContrastError:
        return {m.name: Issue(NO_CONTRAST) for m in group.moving}
    return {
        m.name: r if isinstance(r, Issue) else replace(r, loss=loss, iterations=steps, recipe=settings.recipe)
        for m, r in zip(group.moving, results, strict=True)
    }


def refine_with(
    net: Descriptor, group: ImageGroup, settings: JointSettings, progress: Progress, patches: int = PATCHES
) -> Results:
    """Optimise every psi of a capture with theta frozen, from at most `patches` patches per image."""
    try:
        results = refine(JointState(settings, progress), net, group, patches=patches)
    except NoContrastError:
        return {m.name: Issue(NO_CONTRAST) for m in group.moving}
    return {
        m.name: r if isinstance(r, Issue) else replace(r, recipe="flight")
        for m, r in zip(group.moving, results, strict=True)
    }


def _by_paper(state: JointState, pair: ImageGroup, training: Training) -> JointResult | Issue:
    try:
        return align_by_paper(state, pair, training)[1]
    except NotEnoughTextureError as error:
        return Issue(FEW_KEYPOINTS, error.keypoints, error.minimum)
    except NoContrastError:
        return Issue(NO_CONTRAST)
    except GeometryError:
        return Issue(NOT_INVERTIBLE)
