#!/usr/bin/env bash
# One large flight on a SLURM cluster: a Dask scheduler and 64 workers, on any number of nodes (`sbatch --nodes=4 …` for
# four). If the time limit ends it, submit it again to resume. SLURM shows exit code 3, "check the results", as FAILED.
# Tested with two workers, without SLURM.
#
#     FLIGHT=/data/flight OUT=/data/aligned sbatch examples/slurm_large.sh
#
# Activate the environment of agalign with '.[dask]' first; all nodes must have it under the same path. OPTIONS replaces
# the options '--radiometry auto --qa'.
#
#SBATCH --ntasks=64 --cpus-per-task=1 --mem-per-cpu=3G --time=12:00:00
set -u
: "${FLIGHT:?folder of the flight}" "${OUT:?folder for the results}"

address=tcp://$(hostname):8786
dask scheduler --port 8786 &
srun dask worker "$address" --nthreads 1 --no-dashboard &
# shellcheck disable=SC2086  # OPTIONS are several words
agalign "$FLIGHT" -o "$OUT" --dask "$address" ${OPTIONS:---radiometry auto --qa}
code=$?
case $code in 0 | 3) agalign indices "$OUT" --index ndvi --mask-qa --dask "$address" || code=$? ;; esac
kill %1 %2
exit $code
