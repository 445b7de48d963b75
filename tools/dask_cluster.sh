#!/usr/bin/env bash
# Align a folder on a Dask cluster on this machine: a scheduler and two worker processes, ended with the run.
#
#     tools/dask_cluster.sh FOLDER -o OUT [options]
set -euo pipefail

workers=${WORKERS:-2}
folder=$(mktemp -d)
address_file=$folder/scheduler.json
trap 'kill $(jobs -p) 2> /dev/null || true; wait; rm -rf "$folder"' EXIT

python3 -m distributed.cli.dask_scheduler --port 0 --no-dashboard --scheduler-file "$address_file" 2> "$folder/scheduler.log" &
for _ in $(seq "$workers"); do
    python3 -m distributed.cli.dask_worker --scheduler-file "$address_file" --nthreads 1 --no-dashboard \
        --local-directory "$folder" 2> "$folder/worker.log" &
done
until [ -s "$address_file" ]; do sleep 0.2; done
address=$(python3 -c "import json, sys; print(json.load(open(sys.argv[1]))['address'])" "$address_file")
agalign "$@" --dask "$address"
