#!/bin/bash
# Merges what the shards have done: sbatch --dependency=afterok:JOB slurm_merge.sh OUT. LTSH is as in slurm_bake.sh.
#
#SBATCH --job-name=ltsh-merge
#SBATCH --open-mode=append
set -u
read -ra ltsh <<<"${LTSH:-blender --command ltsh}"
exec "${ltsh[@]}" merge "$@"
