#!/usr/bin/env bash
# Many flights on a SLURM cluster: a task for each folder below FLIGHTS. OUT gets a folder of the same name for each, and
# incomplete.txt, which lists the flights with exit code 3. OPTIONS replaces the options '--radiometry auto --qa'.
#
#     export FLIGHTS=season OUT=aligned
#     sbatch --array=1-"$(ls -d "$FLIGHTS"/*/ | wc -l)" examples/slurm.sh
#
# Activate the environment of agalign first. A task that SLURM kills leaves no lock: submit it again, and it resumes.
#
#SBATCH --cpus-per-task=4
#SBATCH --mem=12G  # twice the memory of 4 jobs with images of 12 megapixels
#SBATCH --time=04:00:00
#SBATCH --requeue
set -uo pipefail
: "${FLIGHTS:?folder with a folder for each flight}" "${OUT:?folder for the results}"

trap : TERM  # at the time limit, SLURM signals this script too: wait for agalign, and requeue
flight=$(ls -d "$FLIGHTS"/*/ | sed -n "${SLURM_ARRAY_TASK_ID:?start it with sbatch --array}p")
name=$(basename "$flight")
# shellcheck disable=SC2086  # OPTIONS are several words
agalign "$flight" -o "$OUT/$name" --jobs "${SLURM_CPUS_PER_TASK:-1}" ${OPTIONS:---radiometry auto --qa}
code=$?
case $code in 0 | 3) agalign indices "$OUT/$name" --index ndvi --mask-qa || code=$? ;; esac

case $code in
    0) ;;
    3) echo "$name" >> "$OUT/incomplete.txt" ;;  # finished: check OUT/<flight>/index.html
    143) exec scontrol requeue "$SLURM_JOB_ID" ;;  # stopped at the time limit: the same command resumes the run
    *) exit "$code" ;;  # 1: nothing could be processed, or no NDVI; 2: wrong options
esac
