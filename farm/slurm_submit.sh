#!/bin/bash
# Submits a job to Slurm: an array of N shards, and a merge that starts when all of them are done.
#
#   slurm_submit.sh 4 bake room.blend -o /shared/out/room --size 2048
#   slurm_submit.sh 12 compare room.blend -o /shared/out/room --frames 1-240
#   slurm_submit.sh 24 render room.blend -o /shared/out/final --frames 1-240
#   slurm_submit.sh 12 run night.toml
#
# SBATCH_OPTIONS goes to both, such as "--partition=night --cpus-per-task=8". Prints the numbers of both Slurm jobs.
set -euo pipefail

usage() {
    echo "slurm_submit.sh: $1; usage: slurm_submit.sh SHARDS bake|compare|shade|render|view SCENE.blend -o OUT" \
        "[OPTION ...], or: slurm_submit.sh SHARDS run JOB.toml" >&2
    exit 2
}

shards=${1:-}
[[ $shards =~ ^[1-9][0-9]*$ ]] || usage "SHARDS is '$shards', expected a whole number above 0"
shift
case ${1:-} in
    bake | compare | shade | render | view)
        merged=
        for ((i = 1; i <= $#; i++)); do
            case ${!i} in
                -o) next=$((i + 1)) && merged=${!next:-} ;;
                -o*) merged=${!i#-o} ;;
            esac
        done
        [ -n "$merged" ] || usage "-o OUT is missing"
        mkdir -p "$merged"
        logs=$merged
        ;;
    run)
        merged=${2:-}
        [ -f "$merged" ] || usage "JOB.toml is '$merged', expected a file"
        logs=$(dirname "$merged")
        ;;
    *) usage "the command is '${1:-}', expected bake, compare, shade, render, view or run" ;;
esac

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
read -ra options <<<"${SBATCH_OPTIONS:-}"
submit() { sbatch --parsable ${options[@]+"${options[@]}"} "$@"; }
array=$(LTSH_SHARDS=$shards submit --array="1-$shards" --output="$logs/slurm_%A_%a.log" "$here/slurm_bake.sh" "$@")
# --parsable may add the name of the cluster, after a semicolon.
array=${array%%;*}
merge=$(submit --dependency="afterok:$array" --kill-on-invalid-dep=yes --output="$logs/slurm_%j_merge.log" \
    "$here/slurm_merge.sh" "$merged")
echo "$array ${merge%%;*}"
