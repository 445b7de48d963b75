#!/usr/bin/env bash
# One large flight on a SLURM cluster: a Dask scheduler and 64 workers. If the time limit ends it, submit it again to
# resume. Tested with two workers, without SLURM.
#
#     FLIGHT=/data/flight OUT=/data/aligned sbatch examples/slurm_large.sh
#
#SBATCH --ntasks=64 --cpus-per-task=1 --mem-per-cpu=3G --time=12:00:00
. /data/agalign/env/bin/activate    # with '.[dask]', on a file system that all nodes have
address=tcp://$(hostname):8786
dask scheduler --port 8786 &
srun dask worker "$address" --nthreads 1 --no-dashboard &
agalign "$FLIGHT" -o "$OUT" --dask "$address"
code=$?
kill %1 %2
exit $code
