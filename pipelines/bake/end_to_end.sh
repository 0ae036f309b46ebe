#!/bin/bash
# Trains the shipped policy `end_to_end` further on a machine with two GPUs, and measures how fast one and two are.
#
#   PYTHONPATH=$PWD:$PWD/pipelines:$PWD/viewers bash pipelines/bake/end_to_end.sh OUT SECONDS
#
# OUT gets, every ten seconds, what there is so far: logs, learning curves and policies of one.* (one GPU, for its speed) and
# two.* (two GPUs, for the rest of SECONDS, 60 to 600). Nothing is lost if it is killed but the last half minute. OPTIONS
# replaces the recipe's options, ONE the share of SECONDS for one GPU, SPACE the folder for checkpoints.
set -u
out=$1 seconds=${2:-480} began=$SECONDS
space=${SPACE:-/tmp/end_to_end}
options=${OPTIONS:---recipe fast --device cuda --warm-start end_to_end --rollout 64 --minibatches 8 --follow-steps 300}
one_s=${ONE:-150} spare_s=12 worlds=${WORLDS:-4096}
export NCCL_NVLS_ENABLE=0 PYTHONUNBUFFERED=1
mkdir -p "$out" "$space"

left() { echo $((seconds - spare_s - SECONDS + began)); }
minutes() { echo "$1" | awk '{ printf "%.3f", $1 / 60 }'; }
keep() {
    for run in one two rest; do
        for file in policy.npz curve.parquet; do
            if [ -f "$space/$run/$file" ]; then
                cp "$space/$run/$file" "$out/.part" && mv "$out/.part" "$out/$run.$file"
            fi
        done
    done
}
train() { # run, seconds of the call, options
    local run=$1 call_s=$2
    shift 2
    echo "$run: $call_s s from second $((SECONDS - began))"
    timeout -k 10 $((call_s + 8)) python3 -m h3data_pipelines.cli train social_nav $options "$@" \
        --stop-after "$(minutes "$call_s")" -o "$space/$run" >"$out/$run.log" 2>&1
    local code=$?
    tail -n 4 "$out/$run.log"
    keep
    return $code
}

(while sleep 10; do keep; done) &
copies=$!
trap 'kill $copies 2>/dev/null; keep' EXIT
nvidia-smi -L 2>/dev/null
train one "$one_s" --worlds "$worlds" --minutes 10
echo "one: exit code $?"
s=$(left)
train two "$s" --worlds $((2 * worlds)) --gpus 2 --minutes "$(minutes "$s")"
code=$?
echo "two: exit code $code"
if [ $code -ne 0 ] && [ "$(left)" -gt 60 ]; then # one GPU is better than none
    s=$(left)
    train rest "$s" --worlds "$worlds" --minutes "$(minutes "$s")"
fi
