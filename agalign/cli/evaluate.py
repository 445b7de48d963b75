"""The commands for the experiments of Dong et al. (2018): evaluate, surface, and learn."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from agalign.cli.command import Command, Given
from agalign.cli.terminal import Terminal
from agalign.errors import ConfigurationError
from agalign.host.own_files import MODEL_MARK, refuse_to_replace
from agalign.host.text import counted
from agalign.values.choices import Sharing

if TYPE_CHECKING:
    from agalign.evaluation.evaluate import Result

Pairs = Annotated[
    Path, typer.Argument(help="A CSV file (fixed, moving, homography), or a folder in the HPatches or Oxford layout.")
]


def _evaluate(
    terminal: Terminal,
    given: Given,
    pairs: Pairs,
    methods: Annotated[list[str] | None, typer.Option("--method", "-m")] = None,
    shift: str = "5",
    directions: Annotated[int, typer.Option(min=1)] = 1,
    seeding: bool = False,
    out: Annotated[Path | None, typer.Option("--out", "-o")] = None,
) -> None:
    """Evaluate descriptors and homographies on pairs with ground truth (Dong et al., 2018).

    Options:
        methods: Recipe and sharing (fast:siamese; fast:siamese:grey for grey images), sift, daisy, ecc, elastix, or a
            network file; repeatable.
        shift: Distances of the start from the truth, % of the longer side, separated by commas.
        directions: Directions of the start for each distance.
        seeding: Correct the start by the initial alignment first, as a run does.
        out: CSV file with a row per pair, method and start; rows that it has are not measured again.
    """
    from agalign.evaluation.evaluate import Starts, error_table, evaluate, method_named, precision_table, write_results
    from agalign.evaluation.image_pairs import find_pairs

    chosen = methods or [*(f"fast:{sharing}" for sharing in get_args(Sharing)), "sift"]
    joint, start = given["settings"]["joint"], ", initial alignment" if seeding else ""
    named = {f"{name}{start}": method_named(name, **joint, seeding=seeding) for name in chosen}
    known, every = find_pairs(pairs), Starts(_shares(shift), directions)
    numbers = {pair.name: number for number, pair in enumerate(known, start=1)}
    results = [] if out is None else _kept_results(out, terminal)
    for result in evaluate(known, named, every, joint["rng_seed"], results.copy()):
        results.append(result)
        if out is not None:
            write_results(out, results)
        text = f"mAP {result.average_precision:.3f}, {result.error_px:.3f} px, {result.seconds:.1f} s"
        line = f"[{numbers[result.pair]}/{len(known)}] {result.pair}, {result.method}, {result.shift:.1%} off: {text}"
        terminal.event("result", line, **vars(result))
    for title, rows in (("Mean average precision", precision_table(results)), ("Homography", error_table(results))):
        if len(rows) > 1:
            terminal.table(rows[0], rows[1:], title)


def _kept_results(out: Path, terminal: Terminal) -> "list[Result]":
    """Read the results of an earlier command, without a last line that was not written to its end."""
    from agalign.evaluation.evaluate import read_results, write_results

    refuse_to_replace(out, b"pair,group,method,")
    results = read_results(out)
    write_results(out, results)
    if results:
        text = f"{out}: {counted(len(results), 'result')} of an earlier command kept"
        terminal.event("kept", text, results=len(results))
    return results


def _surface(
    terminal: Terminal,
    given: Given,
    pairs: Pairs,
    out: Annotated[Path, typer.Option("--out", "-o")] = Path("loss-surface.png"),
    number: Annotated[int, typer.Option(min=1)] = 1,
    reach: Annotated[float, typer.Option(min=1)] = 100.0,
    points: Annotated[int, typer.Option(min=3)] = 17,
    epochs: Annotated[int, typer.Option(min=1)] = 2,
) -> None:
    """Plot the training loss over misalignments of a pair (figure 2 of Dong et al., 2018).

    Options:
        out: Picture to write.
        number: Number of the pair, from 1.
        reach: Largest offset, px.
        points: Offsets along each axis.
        epochs: Training epochs for each offset.
    """
    import numpy as np

    from agalign.config import JointSettings
    from agalign.evaluation.image_pairs import find_pairs, read_image
    from agalign.evaluation.surface import draw_surface, loss_surface
    from agalign.method.paper import Training

    if out.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        raise ConfigurationError(f"{out}: is not the name of a picture, such as loss-surface.png")
    refuse_to_replace(out, None)
    known = [p for p in find_pairs(pairs) if p.fixed_to_moving is not None]
    if number > len(known):
        raise ConfigurationError(f"{pairs}: has {len(known)} pairs with a homography, not {number}")
    pair = known[number - 1]
    offsets = np.linspace(-reach, reach, points)
    settings = JointSettings(recipe="paper", **given["settings"]["joint"])
    images = read_image(pair.fixed), read_image(pair.moving)
    assert pair.fixed_to_moving is not None

    def progress(share: float) -> None:
        terminal.event("surface", f"{share:.0%}" if terminal.verbose else "", share=round(share, 3))

    training = Training(epochs=epochs)
    result = loss_surface(*images, pair.fixed_to_moving, offsets, settings, training, progress=progress)
    draw_surface(result, offsets, out)
    terminal.event("surface", f"{out}: {pair.name}", file=str(out))


def _learn(
    terminal: Terminal,
    given: Given,
    pairs: Pairs,
    out: Annotated[Path, typer.Option("--out", "-o")] = Path("learned.safetensors"),
    steps: Annotated[int, typer.Option(min=1)] = 200,
) -> None:
    """Learn one descriptor from pairs without labels, using those that can be aligned.

    Options:
        out: Network to write.
        steps: Training steps per aligned pair.
    """
    from agalign.config import Settings
    from agalign.evaluation.descriptor_learning import learn_descriptor, read_rough_pairs
    from agalign.flight.model import save_model
    from agalign.values.alignment import Alignment

    refuse_to_replace(out, MODEL_MARK)
    aligned = 0

    def on_pair(name: str, result: Alignment) -> None:
        nonlocal aligned
        aligned += result.status == "aligned"
        text = f"{name}: {result.status}" + (f" ({result.reason})" if result.reason else "")
        text = text if terminal.verbose or result.status != "aligned" else ""
        terminal.event("pair", text, name=name, status=result.status, reason=result.reason or "")

    result = read_rough_pairs(pairs)
    model = learn_descriptor(result, Settings.model_validate(given["settings"]), steps_a_pair=steps, on_pair=on_pair)
    save_model(model, out)
    terminal.event("learned", f"{out}: learned from {aligned} of {len(result)} pairs", file=str(out))


_command = partial(
    Command, panels={"Options": "device", "Running": "rng_seed quiet verbose log_json"}, panel="Descriptors"
)
evaluate, surface = _command(_evaluate), _command(_surface)
learn = _command(_learn, panels={"Options": "sharing device", "Running": "rng_seed quiet verbose log_json"})


def _shares(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) / 100 for part in text.split(","))
    except ValueError:
        raise ConfigurationError(f"'{text}' is not a list of percentages, such as 0,5,10") from None
