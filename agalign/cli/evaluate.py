"""The commands for the experiments of Dong et al. (2018): evaluate, surface, and learn."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from agalign.cli.terminal import LogJson, Quiet, RngSeed, Terminal, Verbose, exits
from agalign.errors import ConfigurationError
from agalign.values.memory_limit import check_address_space

if TYPE_CHECKING:
    from rich.table import Table

Pairs = Annotated[
    Path,
    typer.Argument(
        help="A CSV file (fixed, moving, homography), or a folder in the HPatches or Oxford layout.", show_default=False
    ),
]
Device = Annotated[str, typer.Option(help="auto, cpu, cuda, cuda:1 …")]


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    for command in (evaluate, surface, learn):
        app.command(rich_help_panel="Descriptors")(command)


def evaluate(
    pairs: Pairs,
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            "-m",
            show_default=False,
            help="Recipe and sharing (fast:siamese; fast:siamese:grey for grey images), sift, daisy, elastix, or a "
            "network file; repeatable.",
        ),
    ] = None,
    shift: Annotated[
        str, typer.Option(help="Distances of the start from the truth, % of the longer side, separated by commas.")
    ] = "5",
    directions: Annotated[int, typer.Option(min=1, help="Directions of the start for each distance.")] = 1,
    seeding: Annotated[
        bool, typer.Option("--seeding", help="Correct the start by the initial alignment first, as a run does.")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="CSV file with a row per pair and method.")] = None,
    device: Device = "auto",
    rng_seed: RngSeed = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Evaluate descriptors and homographies on pairs with ground truth (Dong et al., 2018)."""
    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal):
        check_address_space()
        from agalign.evaluation.image_pairs import find_pairs
        from agalign.evaluation.methods import method_named
        from agalign.evaluation.run import Starts, as_csv, error_table, evaluate, precision_table
        from agalign.values.files import write_text

        chosen = methods or ["fast:pseudo-siamese", "fast:siamese", "sift"]
        named = {name: method_named(name) for name in chosen}
        starts = Starts(_shares(shift), directions, seeding)
        results = []
        try:
            for result in evaluate(find_pairs(pairs), named, starts, device, rng_seed):
                results.append(result)
                line = f"{result.pair}, {result.method}: mAP {result.average_precision:.3f}, {result.error_px:.3f} px"
                terminal.event("result", line if verbose else "", **vars(result))
        finally:
            if out is not None and results:
                write_text(out, as_csv(results))
        for title, rows in (("Mean average precision", precision_table(results)), ("Homography", error_table(results))):
            if len(rows) > 1:
                terminal.result(_table(title, rows))


def surface(
    pairs: Pairs,
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path("loss-surface.png"),
    number: Annotated[int, typer.Option(min=1, help="Number of the pair, from 1.")] = 1,
    reach: Annotated[float, typer.Option(min=1, help="Largest offset, px.")] = 100.0,
    points: Annotated[int, typer.Option(min=3, help="Offsets along each axis.")] = 17,
    epochs: Annotated[int, typer.Option(min=1, help="Training epochs for each offset.")] = 2,
    device: Device = "auto",
    rng_seed: RngSeed = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Plot the training loss over misalignments of a pair (figure 2 of Dong et al., 2018)."""
    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal):
        check_address_space()
        import numpy as np

        from agalign.config import JointSettings
        from agalign.evaluation.image_pairs import find_pairs, read_image
        from agalign.evaluation.surface import draw_surface, loss_surface
        from agalign.method.paper import Training

        if out.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
            raise ConfigurationError(f"{out}: is not the name of a picture, such as loss-surface.png")
        known = [p for p in find_pairs(pairs) if p.fixed_to_moving is not None]
        if number > len(known):
            raise ConfigurationError(f"{pairs}: has {len(known)} pairs with a homography, not {number}")
        pair = known[number - 1]
        offsets = np.linspace(-reach, reach, points)
        settings = JointSettings(recipe="paper", device=device, rng_seed=rng_seed)
        images = read_image(pair.fixed), read_image(pair.moving)
        assert pair.fixed_to_moving is not None

        def progress(share: float) -> None:
            terminal.event("surface", f"{share:.0%}" if verbose else "", share=round(share, 3))

        training = Training(epochs=epochs)
        result = loss_surface(*images, pair.fixed_to_moving, offsets, settings, training, progress=progress)
        draw_surface(result, offsets, out)
        terminal.event("surface", f"{out}: {pair.name}", file=str(out))


def learn(
    pairs: Pairs,
    out: Annotated[Path, typer.Option("--out", "-o", help="Network to write.")] = Path("learnt.safetensors"),
    steps: Annotated[int, typer.Option(min=1, help="Training steps per aligned pair.")] = 200,
    sharing: Annotated[str, typer.Option(help="siamese, pseudo-siamese or unshared.")] = "pseudo-siamese",
    device: Device = "auto",
    rng_seed: RngSeed = 0,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> None:
    """Learn one descriptor from pairs without labels, using those that can be aligned."""
    terminal = Terminal(quiet=quiet, verbose=verbose, log_json=log_json)
    with exits(terminal):
        check_address_space()
        from pydantic import ValidationError

        from agalign.config import JointSettings, Settings
        from agalign.evaluation.learn import Lesson, learn_descriptor, read_rough_pairs
        from agalign.flight.model import save_model

        try:
            joint = JointSettings.model_validate({"sharing": sharing, "device": device, "rng_seed": rng_seed})
        except ValidationError:
            raise ConfigurationError(f"'{sharing}' is unknown; choose from siamese, pseudo-siamese, unshared") from None
        aligned = 0

        def on_pair(lesson: Lesson) -> None:
            nonlocal aligned
            aligned += lesson.status == "aligned"
            text = f"{lesson.name}: {lesson.status}" + (f" ({lesson.reason})" if lesson.reason else "")
            terminal.event("pair", text if verbose or lesson.status != "aligned" else "", **vars(lesson))

        settings = Settings(joint=joint)
        result = read_rough_pairs(pairs)
        model = learn_descriptor(result, settings, steps_a_pair=steps, on_pair=on_pair)
        save_model(model, out)
        terminal.event("learnt", f"{out}: learned from {aligned} of {len(result)} pairs", file=str(out))


def _shares(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) / 100 for part in text.split(","))
    except ValueError:
        raise ConfigurationError(f"'{text}' is not a list of percentages, such as 0,5,10") from None


def _table(title: str, rows: list[list[str]]) -> "Table":
    from rich.table import Table

    table = Table(*rows[0], title=title)
    for row in rows[1:]:
        table.add_row(*row)
    return table
