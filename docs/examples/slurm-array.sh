#!/bin/bash
# One size of levels per task, each on the cores of one machine: sbatch docs/examples/slurm-array.sh
# A task that is preempted or out of time is requeued, and the same command resumes.
#SBATCH --job-name=levelproof
#SBATCH --array=0-2
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=32
#SBATCH --mem-per-cpu=2G
#SBATCH --time=04:00:00
#SBATCH --signal=B:TERM@60
#SBATCH --requeue
#SBATCH --open-mode=append
set -u
sizes=(s m l)
size=${sizes[$SLURM_ARRAY_TASK_ID]}
export LEVELPROOF_CACHE_DIR=${TMPDIR:-/tmp}/levelproof-$UID # on the machine's own disk: homes may be shared

levelproof generate size="$size" levels=100k budget=256k checkpoint=10min out=data &
job=$!
trap 'kill -TERM "$job"; wait "$job"; scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"; exit 0' TERM
wait "$job"
