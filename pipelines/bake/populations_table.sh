#!/bin/bash
# Plays the trained robots of populations.sh with the ten partners of the zero-shot population.
#
#   PYTHONPATH=$PWD:$PWD/pipelines:$PWD/viewers bash pipelines/bake/populations_table.sh TRAINED OUT SECONDS
#
# TRAINED is the folder that populations.sh filled. OUT gets natural/ and paper/ (how people walk) with table.txt, table.json and
# a small file for each episode; it goes on where it was. EPISODES is their number (default 50), SEED the seed, SCENES the homes.
set -u
trained=$1 out=$2 seconds=${3:-480}
episodes=${EPISODES:-50} seed=${SEED:-9101} scenes=${SCENES:-h3-homes/test}
workers=${WORKERS:-$(env -u OMP_NUM_THREADS nproc)}
export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
mkdir -p "$out"

weights() { # RUN.SEED FILE...
    local run=$1 found=""
    shift
    for file in "$@"; do
        [ -f "$trained/$run.$file.npz" ] && found="$found,weights:$trained/$run.$file.npz"
    done
    echo "$found"
}
robots=complement
for run in learn_single.0 plan_pop_1.0 plan_pop_2.0 plan_pop_3.0 plan_pop_4.0 learn_pop.0; do
    robots=$robots$(weights $run policy)
done
ten=both,object_1,object_2,still
for seed_of in 0 1 2; do
    ten=$ten$(weights learn_single.$seed_of partner_0)
done
ten=$ten$(weights learn_pop.0 partner_0 partner_1 partner_2)

end=$((SECONDS + seconds))
for walk in paper natural; do
    steps=$([ $walk = paper ] && echo 750 || echo 1500)
    timeout -k 10 $((end - SECONDS)) python3 -m h3data_pipelines.cli evaluate rearrange --scenes "$scenes" --seed "$seed" \
        --episodes "$episodes" --human-walk $walk --max-steps $steps --policies "$robots" --partners "$ten" --zsc "$ten" \
        --workers "$workers" -o "$out/$walk" >"$out/$walk.log" 2>&1 || echo "$walk: stopped after $SECONDS s"
    mv -f "$out/$walk.log" "$out/$walk/evaluate.log" 2>/dev/null
done
cat "$out"/*/table.txt
