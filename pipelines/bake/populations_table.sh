#!/bin/bash
# Plays trained robots of rearrangement with the ten partners of the zero-shot population and with those they learned beside.
#
#   PYTHONPATH=$PWD:$PWD/pipelines:$PWD/viewers bash pipelines/bake/populations_table.sh TRAINED OUT SECONDS
#
# TRAINED has the folders of runs, RUN.SEED as from many_runs.sh: every RUN.SEED/policy.npz plays, and an untrained robot. OUT gets
# WALK/RUN.SEED/ (WALK is natural or paper, how people walk, or oracle: oracle skills), each the folder of one h3data evaluate
# with a small file for each episode, and rows.md, the table over seeds (populations_rows.py). The same call goes on where it
# was, also with more robots. People of Learn-Single and Learn-Pop that TRAINED lacks are those of the package.
#
# RUNS names the runs (default: all there are, and untrained), SEEDS the seeds (0 1 2), WALKS is some of natural, paper and
# oracle (natural paper), EPISODES their number (50), SEED that of the episodes, SCENES the homes. SKILLS=learned gives robots
# learned skills, by default Plan-Pop 3; their folders are RUN_learned_skills.SEED. All evaluations go on at once, WORKERS processes each.
set -u
trained=$1 out=$2 seconds=${3:-480}
seeds=${SEEDS:-0 1 2} walks=${WALKS:-natural paper} skills=${SKILLS:-}
cores=$(env -u OMP_NUM_THREADS nproc)
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
mkdir -p "$out"

weights() { # NAME FALLBACK
    [ -f "$trained/$1.npz" ] && echo "weights:$trained/$1.npz" || echo "$2"
}
ten=both,object_1,object_2,still
for k in 0 1 2; do ten=$ten,$(weights learn_single.$k/partner_0 learn_single_partner_$k); done
for k in 0 1 2; do ten=$ten,$(weights learn_pop.0/partner_$k learn_pop_partner_$k); done

untrained() { # SEED: random weights, as training begins with them
    local file=$trained/untrained.$1/policy.npz
    mkdir -p "$trained/untrained.$1"
    [ -f "$file" ] || python3 -c "import sys
from h3data_training.populations import learner, settings
from sim_kinematic.policies.visual_policy import save_policy
save_policy(learner.ChooserLearner(settings.PopulationSettings(), 'robot', seed=int(sys.argv[1])).network(), sys.argv[2])" \
        "$1" "$file"
}
runs=${RUNS:-}
if [ -z "$runs" ] && [ -n "$skills" ]; then
    runs=plan_pop_3
elif [ -z "$runs" ]; then
    runs="$(cd "$trained" && ls -- */policy.npz 2>/dev/null | sed 's/\.[0-9]*\/policy\.npz$//' | sort -u) untrained"
fi
tasks=()
for walk in $walks; do
    for seed in $seeds; do
        for run in $(printf '%s\n' $runs | sort -u); do
            [ "$run" = untrained ] && untrained "$seed"
            [ -f "$trained/$run.$seed/policy.npz" ] && tasks+=("$walk $run $seed")
        done
    done
done
[ ${#tasks[@]} -gt 0 ] || { echo "No RUN.SEED/policy.npz of $runs in $trained." >&2 && exit 1; }
together=$((${#tasks[@]} < cores ? ${#tasks[@]} : cores))
workers=${WORKERS:-$(((cores + together - 1) / together))}
echo "${#tasks[@]} evaluations, $together at once, $workers workers each, $cores cores, $seconds s"

evaluate() { # WALK RUN SEED
    local folder=$out/$1/$2${skills:+_learned_skills}.$3 partners=$ten file
    for file in "$trained/${2%%_no_*}.$3"/partner_*.npz; do # those it learned beside
        case ",$partners," in *",weights:$file,"*) continue ;; esac
        [ -f "$file" ] && partners=$partners,weights:$file
    done
    local left=$((end - $(date +%s))) rules="--human-walk $1 --max-steps $([ "$1" = paper ] && echo 750 || echo 1500)"
    [ "$1" = oracle ] && rules="--skills oracle"
    [ $left -gt 0 ] || return 0
    mkdir -p "$out/$1"
    timeout --foreground -k 10 $left python3 -m h3data_pipelines.cli evaluate rearrange --scenes "${SCENES:-h3-homes/test}" \
        --seed "${SEED:-9101}" --episodes "${EPISODES:-50}" $rules --policies "weights:$trained/$2.$3/policy.npz" \
        --partners "$partners" --unseen-partners "$ten" ${skills:+--skills "$skills"} --workers "$workers" -o "$folder" \
        >"$folder.log" 2>&1 || echo "$1 $2 $3: failed or stopped, see $folder.log"
}
export -f evaluate
export trained out skills ten workers end=$(($(date +%s) + seconds))
set -m # a process group of its own, to be stopped as one
xargs -P "$together" -L 1 bash -c 'evaluate "$@"' evaluate < <(printf '%s\n' "${tasks[@]}") &
waited=$!
trap 'kill -- -"$waited" 2>/dev/null; exit 143' TERM INT HUP
wait "$waited"
python3 -m bake.populations_rows "$out" | tee "$out/rows.md"
