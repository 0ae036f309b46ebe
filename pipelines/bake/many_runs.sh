#!/bin/bash
# Trains many runs of `h3data train` at once on a machine with several GPUs.
#
#   PYTHONPATH=$PWD:$PWD/pipelines:$PWD/viewers bash pipelines/bake/many_runs.sh RUNS OUT SECONDS
#
# RUNS is a file of lines `NAME GPU WAIT_S OPTIONS`: OPTIONS of h3data train, on that GPU (-: none), WAIT_S seconds after the
# beginning; a line that begins with # is skipped. OUT/runs.tar.gz gets, every fifteen seconds, logs, learning curves and policies
# of all runs; CHECKPOINTS=1 adds checkpoints. SPACE is the folder of the runs: where it has checkpoints, they go on.
set -u
runs=$1 out=$2 seconds=${3:-480} began=$SECONDS
space=${SPACE:-/tmp/many_runs}
kinds="-name *.log -o -name *.npz -o -name curve.parquet"
[ "${CHECKPOINTS:-0}" = 1 ] && kinds="$kinds -o -name checkpoint.pt"
export NCCL_NVLS_ENABLE=0 PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
mkdir -p "$out" "$space"

keep() {
    (cd "$space" && set -f && find . $kinds | tar czf "$out/.part" -T - 2>/dev/null && mv "$out/.part" "$out/runs.tar.gz")
}
train() { # NAME GPU WAIT_S OPTIONS
    local name=$1 gpu=$2 wait_s=$3
    shift 3
    sleep "$wait_s"
    mkdir -p "$space/$name"
    [ "$gpu" != - ] && export CUDA_VISIBLE_DEVICES=$gpu
    timeout -k 10 $((seconds - 8 - SECONDS + began)) python3 -m h3data_pipelines.cli train "$@" --resume -o "$space/$name" \
        >>"$space/$name.log" 2>&1
    echo "$name: exit code $? after $((SECONDS - began)) s; $(tail -n 1 "$space/$name.log" | cut -c -200)"
}

processes=()
while read -r name gpu wait_s options; do
    case "$name" in '' | '#'*) continue ;; esac
    train "$name" "$gpu" "$wait_s" $options &
    processes+=($!)
done <"$runs"
(while sleep 15; do keep; done) &
copies=$!
trap 'kill $copies 2>/dev/null; keep' EXIT
wait "${processes[@]}"
