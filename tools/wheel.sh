#!/usr/bin/env bash
# Build the sdist and the wheel from it, check their contents, and test the wheel outside this folder.
#
#     tools/wheel.sh [OUT]        # OUT keeps them
#
# The builds and the wheel use the packages of the active environment (the dev extra), because their installation takes
# minutes.
set -euo pipefail
cd "$(dirname "$0")/.."

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
out=${1:-$folder/dist}

python3 -m build --no-isolation --outdir "$out" . > "$folder/build.log" 2>&1 || { cat "$folder/build.log"; exit 1; }
python3 -m build --no-isolation --wheel --outdir "$folder/direct" . > "$folder/build.log" 2>&1 || { cat "$folder/build.log"; exit 1; }
version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' agalign/_version.py)
sdist=$out/agalign-$version.tar.gz wheel=$out/agalign-$version-py3-none-any.whl
cmp "$wheel" "$folder/direct/$(basename "$wheel")"
python3 -m twine check --strict "$sdist" "$wheel"

# The wheel contains exactly the package; the sdist also contains the build files.
python3 - "$sdist" "$wheel" << 'PY'
import sys, tarfile, zipfile
from pathlib import Path

sdist, wheel = sys.argv[1:]
stem = Path(sdist).name.removesuffix(".tar.gz")
package = {p.as_posix() for p in Path("agalign").rglob("*") if p.is_file() and "__pycache__" not in p.parts}
for name in ("py.typed", "report/page/page.html.j2", "report/page/page.css", "report/page/start.js", "method/starter.safetensors"):
    assert f"agalign/{name}" in package, name
facts = {f"{stem}.dist-info/{n}" for n in ("METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE")}
held = set(zipfile.ZipFile(wheel).namelist())
assert held == package | facts, held ^ (package | facts)
other_files = {"PKG-INFO", "pyproject.toml", "constraints.txt", ".gitignore"}
other_files |= {"README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"}
held = {m.name.removeprefix(f"{stem}/") for m in tarfile.open(sdist).getmembers() if m.isfile()}
assert held == package | other_files, held ^ (package | other_files)
print(f"{Path(wheel).name}: {len(package)} files, {Path(wheel).stat().st_size >> 10} kB")
PY

python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --no-deps --no-index "$wheel"
python3 -c 'import sys; print(*(p for p in sys.path if p.endswith("site-packages")), sep="\n")' \
    > "$("$folder/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/what-it-needs.pth"
unset PYTHONPATH
cd "$folder"
where=$(venv/bin/python -c 'import agalign; print(agalign.__file__)')
case $where in "$folder"/venv/*) ;; *) echo "tried was $where, not the wheel" >&2; exit 1 ;; esac
test "$(venv/bin/agalign --version | sed -n 1p)" = "agalign $version"
venv/bin/agalign demo demo --captures 1 --quiet
test -s demo/aligned/index.html
echo "the wheel by itself: version, demo"
