#!/bin/bash
# One shard of a job as a task of a Slurm array. README.md in this folder says more; usually slurm_submit.sh calls it:
#
#   sbatch --array=1-4 slurm_bake.sh bake room.blend -o /shared/out/room --size 2048
#   LTSH_SHARDS=4 sbatch --array=3 slurm_bake.sh ...       does shard 3 of 4 again
#
# LTSH          the command, "blender --command ltsh" unless set
# LTSH_SHARDS   number of shards, unless the array is 1-N
# LTSH_RETRIES  how often a failed task is put back into the queue, 2 unless set
#
#SBATCH --job-name=ltsh
#SBATCH --requeue
#SBATCH --open-mode=append
set -u

if [ -z "${SLURM_ARRAY_TASK_ID:-}" ]; then
    echo "slurm_bake.sh: is no task of an array, expected sbatch --array=1-N" >&2
    exit 2
fi
if [ -z "${LTSH_SHARDS:-}" ]; then
    if [ "$SLURM_ARRAY_TASK_MIN" != 1 ] || [ "$SLURM_ARRAY_TASK_COUNT" != "$SLURM_ARRAY_TASK_MAX" ]; then
        echo "slurm_bake.sh: the array does not go from 1 to N; say with LTSH_SHARDS how many shards there are" >&2
        exit 2
    fi
    LTSH_SHARDS=$SLURM_ARRAY_TASK_MAX
fi
# Shading, Cycles and bakes take the cores that Slurm gave.
export LTSH_CORES=${SLURM_CPUS_PER_TASK:-${LTSH_CORES:-}}

read -ra ltsh <<<"${LTSH:-blender --command ltsh}"
"${ltsh[@]}" "$@" --shard "$SLURM_ARRAY_TASK_ID/$LTSH_SHARDS" --resume
code=$?

# Wrong arguments (2) stay wrong. Anything else may be the machine: what the task has finished is kept.
if [ $code -ne 0 ] && [ $code -ne 2 ] && [ "${SLURM_RESTART_COUNT:-0}" -lt "${LTSH_RETRIES:-2}" ]; then
    echo "slurm_bake.sh: exit code $code, back into the queue" >&2
    scontrol requeue "$SLURM_JOB_ID" && sleep 60
fi
exit $code
