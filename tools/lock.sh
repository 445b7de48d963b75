#!/usr/bin/env bash
# Write the lock files from pyproject.toml and constraints.txt (needs uv: pip install uv): the newest compatible version
# of each package, with hashes, for every platform and Python 3.11 and newer.
#
#     tools/lock.sh
#
#   locks/build.txt       build dependencies of the wheel
#   locks/image.txt       dependencies of the container image without PyTorch
#   locks/dev.txt         further dependencies of tests and linters
#   locks/torch-cuda.txt  PyTorch with CUDA and CUDA's libraries
#   locks/torch-cpu.txt   PyTorch without: by hand, it says why
set -euo pipefail
cd "$(dirname "$0")/.."

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

compile() {  # compile OUT [options of uv]
    local out=$1
    shift
    uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
        --no-emit-index-url --no-emit-find-links --constraints constraints.txt --output-file "$out" "$@" > /dev/null
}

# PyTorch and its Linux dependencies have a separate file, so that CPU and CUDA versions use the same other locks.
part() {  # part yes|no FILE
    awk -v wanted="$1" '/^[a-z]/ { own = /^(torch|triton|nvidia-[a-z0-9-]+|cuda-[a-z]+)==/ ? "yes" : "no" } own == wanted' "$2"
}

write() {  # write FILE, from standard input
    { echo "# Written by tools/lock.sh."; cat; } > "locks/$1"
}

echo hatchling > "$folder/build.in"
compile "$folder/build.txt" "$folder/build.in"
compile "$folder/image.txt" --extra dask --extra xarray pyproject.toml
compile "$folder/dev.txt" --extra dev --constraints "$folder/image.txt" pyproject.toml

write build.txt < "$folder/build.txt"
part no "$folder/image.txt" | write image.txt
part yes "$folder/image.txt" | write torch-cuda.txt
part no "$folder/dev.txt" | awk 'FNR == NR { known[$0]; next } /^[a-z]/ { own = !($0 in known) } own' locks/image.txt - |
    write dev.txt

torch=$(grep -m1 '^torch==' constraints.txt)
if ! grep -q "^$torch+cpu " locks/torch-cpu.txt; then
    echo "locks/torch-cpu.txt is not of $torch: write its version and its wheels' hashes there (pip hash FILE)" >&2
    exit 1
fi
