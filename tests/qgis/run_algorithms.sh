#!/usr/bin/env bash
# Run every algorithm of the plugin in a real QGIS, without a display, on the flight of `agalign demo`.
#
#     tests/qgis/run_algorithms.sh AGALIGN [FOLDER]     # AGALIGN is the executable; FOLDER keeps everything
#
# Exit code 77 where there is no QGIS.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
agalign=$1
folder=$(realpath "${2:-$(mktemp -d)}")
[ $# -ge 2 ] || trap 'rm -rf "$folder"' EXIT

# Debian's wrapper passes an option that the program does not know.
qgis_process=$(command -v qgis_process.bin || command -v qgis_process) || { echo "no QGIS here" >&2; exit 77; }
mkdir -p "$folder/profile/profiles/default/python/plugins" "$folder/bin" "$folder/run"
chmod 700 "$folder/run"
"$root/tools/qgis_plugin.sh" "$folder/agalign_provider.zip" > /dev/null
python3 -m zipfile -e "$folder/agalign_provider.zip" "$folder/profile/profiles/default/python/plugins"
ln -sf "$(realpath "$agalign")" "$folder/bin/agalign"
export QT_QPA_PLATFORM=offscreen QGIS_CUSTOM_CONFIG_PATH=$folder/profile XDG_RUNTIME_DIR=$folder/run
export PATH=$folder/bin:/usr/bin:/bin
unset PYTHONPATH VIRTUAL_ENV PYTHONHOME

run() {  # ALGORITHM WORDS-IN-THE-OUTPUT PARAMETERS...
    local algorithm=$1 expected=$2
    shift 2
    "$qgis_process" run "agalign:$algorithm" -- "$@" > "$folder/$algorithm.log" 2>&1 \
        || { cat "$folder/$algorithm.log" >&2; echo "agalign:$algorithm failed" >&2; exit 1; }
    grep -Eq "$expected" "$folder/$algorithm.log" \
        || { cat "$folder/$algorithm.log" >&2; echo "agalign:$algorithm: no '$expected' in its output" >&2; exit 1; }
    echo "agalign:$algorithm: ok"
}

"$qgis_process" plugins enable agalign_provider > "$folder/plugins.log" 2>&1
"$qgis_process" list > "$folder/list.log" 2>&1
for algorithm in alignflight indices onto inspect; do
    grep -q "agalign:$algorithm" "$folder/list.log" || { echo "agalign:$algorithm is not listed" >&2; exit 1; }
done

# Paths are relative to the folder of qgis_process.
cd "$folder"
[ -d demo/flight ] || agalign demo demo > /dev/null
flight=demo/flight out=aligned
run inspect '^CAPTURES:	3$' INPUT="$flight"
run alignflight '^CAPTURES:	3$' INPUT="$flight" OUTPUT="$out" RADIOMETRY=1 GEOREFERENCE=true GROUND=0 QA=true
test -s "$out/flight.geojson" && test -s "$out/index.html"
run indices '^RASTERS:	6$' INPUT="$out" INDICES=ndvi,ndre MASK_QA=true
stacks=("$out"/0000SET/000/IMG_000[12].tif)
run onto 'REPORT' REFERENCE="${stacks[0]}" MOVING="${stacks[1]}" OUTPUT="$folder/onto" OPTIONS="--overwrite"

# What the command line refuses reaches the user as its one line, without a traceback.
if "$qgis_process" run agalign:alignflight -- INPUT="$folder/run" OUTPUT="$folder/none" > "$folder/refused.log" 2>&1; then
    echo "a folder without images was accepted" >&2
    exit 1
fi
grep -q "no .tif" "$folder/refused.log" || { cat "$folder/refused.log" >&2; exit 1; }
if grep -q Traceback "$folder"/*.log; then
    echo "a traceback in $folder" >&2
    exit 1
fi
