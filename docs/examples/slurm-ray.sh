#!/bin/bash
# Ray on several machines of one allocation, and one job on all of them: sbatch docs/examples/slurm-ray.sh
#SBATCH --job-name=levelproof
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --exclusive
#SBATCH --cpus-per-task=32
#SBATCH --mem-per-cpu=2G
#SBATCH --time=04:00:00
#SBATCH --signal=B:TERM@60
#SBATCH --requeue
#SBATCH --open-mode=append
set -u
export LEVELPROOF_CACHE_DIR=${TMPDIR:-/tmp}/levelproof-$UID # on the machine's own disk: homes may be shared
mapfile -t hosts < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
head=${hosts[0]}
export RAY_ADDRESS=$head:6379 OMP_NUM_THREADS=1

start() { # levelproof keeps 80 MB in Ray's object store, which would otherwise take a third of the memory
    srun --nodes=1 --ntasks=1 --overlap --nodelist="$1" \
        ray start --block --num-cpus="$SLURM_CPUS_PER_TASK" --object-store-memory=100000000 "${@:2}" &
}
start "$head" --head --port=6379
until ray status > /dev/null 2>&1; do kill -0 $! || exit 1; sleep 1; done
for host in "${hosts[@]:1}"; do start "$host" --address="$RAY_ADDRESS"; done

# B: above signals only this script, which stops the command; its workers live on to commit decided levels
levelproof generate size=s levels=6M budget=256k checkpoint=10min out=data &
job=$!
trap 'kill -TERM "$job"; wait "$job"; scontrol requeue "$SLURM_JOB_ID"; exit 0' TERM
wait "$job"
