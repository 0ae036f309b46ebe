#!/bin/bash
# Trains rearrangement beside all populations of the paper, at once, on the cores of one machine.
#
#   PYTHONPATH=$PWD:$PWD/pipelines:$PWD/viewers bash pipelines/bake/populations.sh OUT SECONDS
#
# Needs no GPU. OUT gets, every ten seconds, what there is so far: log, learning curve, checkpoint and policies of RUN.*; nothing
# is lost if it is killed but the last half minute. Where OUT has checkpoints, runs go on. RUNS names them, POPULATION:SEED or
# POPULATION:SEED:ABLATION (no_gps, no_primitives; files are POPULATION_ABLATION.SEED.*);
# WORKERS is the number of processes of each (default: cores shared, and half as many again, since runs learn one after the
# other), EPISODES the file of episodes, MINUTES the length of a run over all calls, OPTIONS more options of h3data train.
set -u
out=$1 seconds=${2:-480}
space=${SPACE:-/tmp/populations}
runs=${RUNS:-learn_pop:0 plan_pop_3:0 learn_single:0 plan_pop_1:0 plan_pop_2:0 plan_pop_4:0 learn_single:1 learn_single:2}
count=$(echo $runs | wc -w) cores=$(env -u OMP_NUM_THREADS nproc)
workers=${WORKERS:-$(((cores * 3 / 2 + count - 1) / count))}
spare_s=12
minutes=${MINUTES:-$(awk "BEGIN { print ($seconds - $spare_s) / 60 }")}
call=$(awk "BEGIN { print ($seconds - $spare_s) / 60 }")
episodes=${EPISODES:-$space/episodes.json.gz}
[ -f "$out/episodes.json.gz" ] && [ -z "${EPISODES:-}" ] && episodes=$out/episodes.json.gz
export PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
mkdir -p "$out" "$space"
echo "$count runs, $workers workers each, $cores cores, $seconds s"

name() { # POPULATION:SEED[:ABLATION]
    local population seed ablation
    IFS=: read -r population seed ablation <<<"$1"
    echo "$population${ablation:+_$ablation}.$seed"
}
options() { # of a run
    local population seed ablation
    IFS=: read -r population seed ablation <<<"$1"
    echo "--population $population --seed $seed"
    case $ablation in
    "") ;;
    no_gps) echo "--without humanoid_gps" ;;
    no_primitives) echo "--without primitives" ;;
    *) echo "Unknown ablation $ablation, expected no_gps or no_primitives." >&2 && return 1 ;;
    esac
}
for run in $runs; do
    options "$run" >/dev/null || exit 2
done
keep() {
    [ -f "$episodes" ] && [ ! -f "$out/episodes.json.gz" ] && cp "$episodes" "$out/episodes.json.gz"
    for run in $runs; do
        local at=$space/$(name "$run")
        for file in "$at"/*.npz "$at"/curve.parquet "$at"/checkpoint.pt; do
            if [ -f "$file" ]; then
                cp "$file" "$out/.part" && mv "$out/.part" "$out/$(name "$run").$(basename "$file")"
            fi
        done
    done
}

if [ ! -f "$episodes" ]; then # once for all runs
    python3 -c "import sys, pathlib; from h3data_training.populations import pool, settings
pool.pool_of(settings.PopulationSettings(), pathlib.Path(sys.argv[1]), workers=pool.default_workers())" "$episodes" || exit 1
fi
processes=()
for run in $runs; do
    at=$space/$(name "$run")
    mkdir -p "$at"
    if [ -f "$out/$(name "$run").checkpoint.pt" ] && [ ! -f "$at/checkpoint.pt" ]; then
        cp "$out/$(name "$run").checkpoint.pt" "$at/checkpoint.pt"
    fi
    timeout -k 10 "$seconds" python3 -m h3data_pipelines.cli train rearrange $(options "$run") \
        --workers "$workers" --episodes-file "$episodes" --minutes "$minutes" --stop-after "$call" --resume ${OPTIONS:-} \
        -o "$at" >>"$out/$(name "$run").log" 2>&1 &
    processes+=($!)
done
(while sleep 10; do keep; done) &
copies=$!
trap 'kill "$copies" "${processes[@]}" 2>/dev/null; wait "${processes[@]}"; keep' EXIT
trap 'exit 143' TERM INT HUP
wait "${processes[@]}"
tail -qn 2 "$out"/*.log
