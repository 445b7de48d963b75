"""Copy the captures of one day, by the time in their tags, to another folder with the same sub-folders.

python examples/one_day.py FOLDER DATE COPY

DATE is the beginning of the time that `agalign info FOLDER` shows, such as 2026-06-21.
"""

import shutil
import sys
from pathlib import Path

import agalign

if len(sys.argv) != 4:
    sys.exit("usage: python examples/one_day.py FOLDER DATE COPY")
folder, date, target = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])
captures = [one for one in agalign.discover(folder).captures if one.captured_at.startswith(date)]
for band in (band for capture in captures for band in capture.bands):
    copy = target / band.path.relative_to(folder)
    copy.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(band.path, copy)
print(f"{len(captures)} captures")
