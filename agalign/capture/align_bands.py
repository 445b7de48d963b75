"""Alignment of the bands of one capture: seeds, estimators, and the decision among what they find."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from agalign.capture.band_pair import BandPair, read_pairs
from agalign.capture.by_relief import UnderRelief, by_relief
from agalign.capture.by_rig import DELIVERED_STD_PX, RigPrediction, rig_predictions
from agalign.capture.by_windows import fitted_to_windows, in_windows_that_agree
from agalign.capture.candidate import BandCandidates, RefinedBand
from agalign.capture.decision import decide
from agalign.capture.full_resolution import at_full_resolution, is_worth_refining
from agalign.capture.map_estimate import with_map_estimates
from agalign.capture.metrics import with_metrics
from agalign.capture.missing_relief import is_extrapolated, spreads_of_relief_px
from agalign.capture.seeding import corrected, find_seed, image_groups
from agalign.config import SeedSettings, Settings
from agalign.flight.model import FlightModel
from agalign.flight.rig import Rig
from agalign.method.device import one_thread
from agalign.method.joint import Results, learn_and_refine, refine_with
from agalign.method.refine import FLIGHT_PATCHES, PATCHES
from agalign.method.state import ImageGroup, Progress
from agalign.pixels.raster import ReadTile
from agalign.values import geometry
from agalign.values.alignment import MIN_TIMES_CHANCE, Alignment, Alignments, JointResult, Seed, relief_of
from agalign.values.capture import Capture
from agalign.values.issues import SEED_ASKED_FOR, Issue
from agalign.values.mapping import PixelMapping
from agalign.values.mapping_error import MappingError
from agalign.values.parallax import Parallax, Relief
from agalign.values.residual import Residual

PairProgress = Callable[[str, str, float], None]
"""Called with the name of the band, the stage and its completed share, 0 to 1."""
_Align = Callable[[ImageGroup, Progress], Results]
"""Optimises the mappings of a group of images."""


def align_capture_bands(
    capture: Capture,
    settings: Settings,
    model: FlightModel | None,
    progress: PairProgress,
    read: ReadTile | None = None,
) -> dict[str, Alignment]:
    """Align every moving band of a capture; return the alignments by band, px of the files.

    A band that cannot be read is `failed`; the others are aligned. `read` reads the pixels of the files, by default
    `read_tile`. Raises UnreadableFileError if the reference cannot be read.
    """
    start_s, size_px = time.perf_counter(), capture.reference.size_px
    progress(capture.reference.name, "reading", 0.0)
    pairs, unusable = read_pairs(capture, settings.seed, model, read)
    aligned = align_pairs(pairs, settings, progress, model, capture)
    between_files = {pair.name: aligned[pair.name].in_file_px(pair.scales, size_px) for pair in pairs}
    relief = relief_of(between_files)
    relief = None if relief is None else relief.on_pixels(size_px)
    result: dict[str, Alignment] = {}
    for pair in pairs:
        progress(pair.name, "measuring", 0.0)
        measured = with_metrics(_as_written(between_files[pair.name], relief), pair)
        result |= {band.name: replace(measured, moving_size_px=band.size_px) for band in pair.bands}
    for band in capture.moving:
        if band.name not in result:
            overlay = Seed("identity", geometry.overlay(size_px, band.size_px), 0.0)
            issues = (unusable[band.name],) if band.name in unusable else ()  # none in a band of the reference's lens
            of_lens = Alignment(
                PixelMapping(overlay.fixed_to_moving), size_px, issues, overlay, moving_size_px=band.size_px
            )
            result[band.name] = of_lens if issues else replace(of_lens, error=MappingError(size_px), std_px=0.0)
    seconds = (time.perf_counter() - start_s) / max(1, len(capture.moving))  # most steps are for all bands together
    return {b.name: replace(result[b.name], seconds=seconds) for b in capture.moving}


def _as_written(alignment: Alignment, relief: Relief | None) -> Alignment:
    """Return an alignment with the relief that is written: a reader of the sidecar has the same mapping."""
    if relief is None or alignment.mapping.parallax is None:
        return alignment
    parallax = Parallax(relief, alignment.mapping.parallax.baseline).with_occlusions()
    error = None if alignment.error is None else replace(alignment.error, parallax=parallax)
    return replace(alignment, mapping=alignment.mapping.with_parallax(parallax), error=error)


def tie_windows(
    capture: Capture, alignments: Mapping[str, Alignment], read: ReadTile | None = None
) -> dict[str, Residual]:
    """Return windows of the moving bands that did not fail, measured under their alignments, by band, px of the files.

    They cover the whole image, with those that a mapping was fitted to: small ones if parallax varies within large
    ones. Raises UnreadableFileError if the reference cannot be read.
    """
    result: dict[str, Residual] = {}
    for pair in read_pairs(capture, SeedSettings(), read=read)[0]:  # no seed is used
        alignment = alignments[pair.bands[0].name]
        if alignment.status != "failed":
            mapping = alignment.mapping.rescaled(pair.scales.fixed, pair.scales.moving)
            windows = pair.windows if mapping.parallax is None else pair.reference.tie_windows
            residual = windows.residuals(pair.warped_moving(mapping)).in_file_px(pair.scales)
            result |= dict.fromkeys((band.name for band in pair.bands), residual)
    return result


@one_thread()
def align_pairs(
    pairs: Sequence[BandPair],
    settings: Settings,
    progress: PairProgress,
    model: FlightModel | None = None,
    capture: Capture | None = None,
) -> Alignments:
    """Align the pairs of one `capture`; return the alignments by name, px of the images."""
    return CaptureEstimation(settings, model, progress).align(pairs, capture)


@dataclass
class CaptureEstimation:
    """The estimators of a capture, in their order; `decide` chooses among what they find.

    Costly ones are for bands that are not delivered without them.
    """

    settings: Settings
    model: FlightModel | None
    progress: PairProgress
    is_observation: bool = False
    """True while a flight is learned: residual lens distortion is fitted to all its captures together."""
    capture: Capture | None = None
    """The capture of the pairs, if its tags are known."""
    bands: dict[str, BandCandidates] = field(default_factory=dict)
    """What was found, by band."""
    reliefs: list[UnderRelief] = field(default_factory=list)
    """The candidates under each relief that fits the capture."""

    def align(self, pairs: Sequence[BandPair], capture: Capture | None, *, relearn: bool = True) -> Alignments:
        """Take all steps; return the alignments.

        For pairs that the flight's network cannot align, one of the capture is learned, with a rig only for those
        without an accurate prediction; without `relearn`, only for pairs that the network does not contain.
        """
        self.capture = capture
        self._find_seeds(pairs)
        if self.settings.seed.only:
            return self.decided()
        self._refine()
        result = self._learn(capture, relearn=relearn)
        result = self._fit_windows(result)
        if self.is_observation:
            return result
        result = self._add_errors_of_relief(result)
        if capture is None:
            return result
        result = self._refine_on_files(result, capture)
        predictions = self._predictions(result, capture)
        return self.decided(predictions) if predictions else result

    def decided(self, predictions: Mapping[str, RigPrediction] | None = None) -> Alignments:
        """Return the alignments by what has been found."""
        return decide(list(self.bands.values()), self.reliefs, predictions)

    def _find_seeds(self, pairs: Sequence[BandPair]) -> None:
        """Find the seeds."""
        for pair in pairs:
            self.progress(pair.name, "seeding", 0.0)
            seed = find_seed(pair, self.settings.seed, self.model)
            is_asked_for = self.settings.seed.only and isinstance(seed, Seed)
            self.bands[pair.name] = BandCandidates(pair, seed, Issue(SEED_ASKED_FOR) if is_asked_for else None)

    @property
    def pairs(self) -> list[BandPair]:
        """The pairs of all bands."""
        return [band.pair for band in self.bands.values()]

    @property
    def seeds(self) -> dict[str, Seed]:
        """The seeds that were found, at which descriptors start."""
        return {name: band.found for name, band in self.bands.items() if isinstance(band.found, Seed)}

    def _refine(self) -> None:
        """Align the bands that the flight's network contains with this network."""
        model = self.model
        if model is None:
            return
        sides = {name: side for name in self.bands if (side := model.side(name)) is not None}
        patches = PATCHES if model.rig is None else FLIGHT_PATCHES

        def refined(group: ImageGroup, report: Progress) -> Results:
            return refine_with(model.net, group, self.settings.joint, report, patches)

        seeds = {name: seed for name, seed in self.seeds.items() if name in sides}
        results = self._optimised(seeds, refined, sides)
        for other_seed in (_corrected, _contradicting):
            lost = [self.bands[name] for name in seeds if not is_retrieved(results[name])]
            again = {band.pair.name: seed for band in lost if (seed := other_seed(band)) is not None}
            for name, result in self._optimised(again, refined, sides).items():
                if is_retrieved(result):
                    results[name], self.bands[name] = result, replace(self.bands[name], found=again[name])
        self.add(results)

    def _learn(self, capture: Capture | None, *, relearn: bool) -> Alignments:
        """Align bands with networks that are learned on the capture alone; return the alignments then."""
        names, result = {name for name, band in self.bands.items() if band.refined is None}, Alignments()
        if self.model is not None:  # else nothing is known, and the windows of all seeds would take long
            result = self.decided()
            names = bands_to_learn(self.pairs, result, self.model.rig, capture) if relearn else names
        remaining = {name: seed for name, seed in self.seeds.items() if name in names}
        if not remaining:
            return result or self.decided()
        joint = self.settings.joint
        self.add(self._optimised(remaining, lambda group, report: learn_and_refine(group, joint, report)))
        return self.decided()

    def _fit_windows(self, result: Alignments) -> Alignments:
        """Estimate bands by windows without descriptors where these have no result; return the alignments then."""
        unusable = {name for name, alignment in result.items() if not alignment.is_usable(DELIVERED_STD_PX)}
        lost = [band for name, band in self.bands.items() if name in unusable - self._under_each_relief]
        if not (lost and self._may_be_homography):
            return result
        by_windows = {band.pair.name: refined for band in lost if (refined := fitted_to_windows(band)) is not None}
        for name, refined in by_windows.items():
            self.bands[name].refined = refined
        for combined in self._combined() if by_windows else ():
            if (name := combined.pair.name) in by_windows:
                self.bands[name].candidates += combined.candidates("never")
        for band in lost:
            if band.pair.name not in by_windows or not band.candidates[-1].may_predict:
                of_coarse = in_windows_that_agree(band)
                band.candidates += [] if of_coarse is None else [of_coarse]
        return self.decided()

    def _add_errors_of_relief(self, result: Alignments) -> Alignments:
        """Add the relief that homographies lack to their errors, where no window is near; return the alignments then.

        Bands that pass without it keep their errors: with it, those of flat fields would be 0.3 to 0.45 px where the
        true ones are 0.1 px.
        """
        rejected = [band for band in self.bands.values() if band.candidates and band.accepted is None]
        extrapolated = [band for band in rejected if is_extrapolated(band.candidates[-1])]
        if not (extrapolated and self._may_be_homography):
            return result
        known = {b.pair.name: b.joint.fixed_to_moving for b in self.refined if b.joint.is_retrieved}
        spreads_px = spreads_of_relief_px(self.pairs, known)
        for band in extrapolated:
            band.candidates = [c.with_relief_std_px(spreads_px[band.pair.name]) for c in band.candidates]
        return self.decided()

    def _predictions(self, result: Alignments, capture: Capture) -> dict[str, RigPrediction]:
        """Return the predictions of the bands by the rig of the flight and the other bands of the capture."""
        rig = None if self.model is None else self.model.rig
        return {} if rig is None else rig_predictions(self.pairs, result, rig, capture)

    def _refine_on_files(self, result: Alignments, capture: Capture) -> Alignments:
        """Refine aligned bands on tiles of files that have more pixels than the images; return the alignments then."""
        if not self._may_be_homography:  # as the refinement is
            return result
        reduced = [band for name, band in self.bands.items() if is_worth_refining(band.pair, result[name])]
        for band in reduced:
            assert band.accepted is not None  # an aligned band has one
            refined = at_full_resolution(capture.reference, band.accepted)
            if isinstance(refined, Issue):
                band.issue, band.candidates = refined, []
            elif refined is not None:
                band.candidates.append(refined)
        return self.decided() if reduced else result

    def _optimised(self, seeds: Mapping[str, Seed], align: _Align, sides: Mapping[str, int] | None = None) -> Results:
        """Return the results of the bands with these `seeds`, with their `sides` of the network."""
        if not seeds:
            return {}
        report = partial(self.progress, next(iter(seeds)))  # with the name of the first band
        report("refining", 0.0)
        results: Results = {}
        for group in image_groups(self.pairs, seeds, sides):
            results |= align(group, report)
        return results

    def add(self, results: Results) -> None:
        """Combine the results of some bands with those of the other bands by MAP estimation, and add the candidates.

        A result whose descriptors are retrieved is not replaced by one whose descriptors are not.
        For an observation of the rig, no displacement fields are fitted. A model family that the user chose is not
        replaced by a relief or a displacement field.
        """
        if not results:
            return
        for name, result in results.items():
            band = self.bands[name]
            if band.refined is None or is_retrieved(result) or not band.refined.joint.is_retrieved:
                band.issue = result if isinstance(result, Issue) else None
                band.refined = RefinedBand.of(band.pair, band.seed, result)
        use = self.settings.relief.use if self._may_be_homography else "never"
        combined = self._combined()
        self.progress(next(iter(results)), "relief", 0.0)  # with the name of the first band
        reliefs, along_a_line = by_relief(combined, use, is_observation=self.is_observation)
        self.reliefs += reliefs
        new = {*results} | {name for name, band in self.bands.items() if not band.candidates}
        for refined in combined:
            name = refined.pair.name
            if name in new - self._under_each_relief and self.bands[name].issue is None:
                self.progress(name, "checking", 0.0)
                field_use = "never" if self.is_observation or name in along_a_line else use
                self.bands[name].candidates += refined.candidates(field_use)

    def _combined(self) -> list[RefinedBand]:
        """Return the refined bands after the MAP estimation of all bands of the capture."""
        if not self._may_be_homography:  # as the MAP estimate is
            return self.refined
        return with_map_estimates(self.refined, None if self.model is None else self.model.rig, self.capture)

    @property
    def _under_each_relief(self) -> set[str]:
        """The bands that get a candidate under a relief, whichever relief is chosen: they need no others."""
        return set.intersection(*map(set, self.reliefs)) if self.reliefs else set()

    @property
    def refined(self) -> list[RefinedBand]:
        """The bands that were optimised, with the last result of each."""
        return [band.refined for band in self.bands.values() if band.refined is not None]

    @property
    def _may_be_homography(self) -> bool:
        """False if the user chose a model family with fewer parameters."""
        return self.settings.joint.model_family in ("auto", "homography")


def _corrected(band: BandCandidates) -> Seed | None:
    """Return the seed that windows correct, as tags may have the wrong scale; None if they do not."""
    assert isinstance(band.found, Seed)
    return corrected(band.pair, band.found)


def _contradicting(band: BandCandidates) -> Seed | None:
    """Return the seed of tags or flight if it contradicts the one that was found; None if it does not."""
    return None if band.seed is band.found else band.seed


def bands_to_learn(pairs: Sequence[BandPair], result: Alignments, rig: Rig | None, capture: Capture | None) -> set[str]:
    """Return the bands for which a network of the capture is learned: those that are not usable without one.

    With a `rig` they are skipped if it predicts them with a standard error of at most DELIVERED_STD_PX, or if they have
    no structure in common with the reference, as over water. Learning helps, for example, in captures from a lower
    height than those of the flight's network.
    """
    lost = [pair.name for pair in pairs if not result[pair.name].is_usable(DELIVERED_STD_PX)]
    if not lost or rig is None or capture is None:
        return set(lost)
    predictions = rig_predictions(pairs, result, rig, capture)

    def is_skipped(name: str) -> bool:
        if name not in predictions:
            return False
        alignment, joint = result[name], result[name].joint
        # Fewer patches than a result needs: a network of its own may retrieve more.
        is_above_chance = joint is not None and joint.retrieval >= MIN_TIMES_CHANCE * joint.chance
        # A seed that replaced one that contradicts it has no score: the images do not confirm it.
        has_common_structure = (alignment.seed.trusted and alignment.seed.score > 0) or is_above_chance
        return not has_common_structure or predictions[name].is_delivered

    return {name for name in lost if not is_skipped(name)}


def is_retrieved(result: JointResult | Issue) -> bool:
    """Return True if the descriptors distinguish held-out patches."""
    return isinstance(result, JointResult) and result.is_retrieved
