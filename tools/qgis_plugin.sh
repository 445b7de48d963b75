#!/usr/bin/env bash
# Make the zip that QGIS installs: Plugins, Manage and Install Plugins, Install from ZIP.
#
#     tools/qgis_plugin.sh [OUT]        # OUT is the zip; dist/agalign_provider.zip by default
set -euo pipefail
cd "$(dirname "$0")/.."

out=$(realpath -m "${1:-dist/agalign_provider.zip}")
version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' agalign/_version.py)
grep -qx "version=$version" qgis/agalign_provider/metadata.txt \
    || { echo "qgis/agalign_provider/metadata.txt: its version is not $version, that of the program" >&2; exit 1; }
mkdir -p "$(dirname "$out")"
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mkdir "$folder/agalign_provider"
cp qgis/agalign_provider/*.py qgis/agalign_provider/metadata.txt LICENSE "$folder/agalign_provider/"
rm -f "$out"
(cd "$folder" && python3 -m zipfile -c "$out" agalign_provider)
echo "$out"
