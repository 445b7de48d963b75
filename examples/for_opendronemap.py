"""A flight laid out for OpenDroneMap: a folder with each aligned band under its own name, with its tags, and no more.

python examples/for_opendronemap.py FLIGHT PROJECT
"""

import shutil
import sys
from pathlib import Path

import agalign


def main() -> None:
    images = Path(sys.argv[2]) / "images"
    images.mkdir(parents=True)
    settings = agalign.Settings(write=agalign.WriteSettings(layout="bands"))
    left_out = []
    for report in agalign.align_folder(sys.argv[1], Path(sys.argv[2]) / "aligned", settings=settings,
                                       run=agalign.RunOptions(jobs=0)):  # fmt: skip
        # A reconstruction is better off without a capture than with a band in the wrong place.
        if report.sidecar is None or report.sidecar.status != "ok":
            left_out.append(report.label)
            continue
        for part in report.sidecar.output.band_files:
            source = report.path.parent / part.file
            shutil.copy(source, images / report.label.replace("/", "_").replace(report.sidecar.capture, source.name))
    print(f"{len(list(images.iterdir()))} files in {images}; left out: {', '.join(left_out) or 'none'}")
    print("docker run -ti --rm -v PROJECT:/datasets/code opendronemap/odm --project-path /datasets "
          "--skip-band-alignment --primary-band Green")  # fmt: skip


if __name__ == "__main__":
    main()
