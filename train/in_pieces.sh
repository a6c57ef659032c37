#!/usr/bin/env bash
# Trains one preset with several seeds in calls of ten minutes, on a machine that may be bare each time:
#
#     bash train/in_pieces.sh PRESET FOLDER [options of lightdepth train]
#
# Call it again until it says that all is done (exit code 0; 75: more is to do). Each seed's run is FOLDER/PRESET-SEED, with
# weights, card, curves and the chart of the uncertainty, which is calibrated at its end. What has to travel between calls is
# one file, FOLDER.tar.gz: where it is there and FOLDER is not, the call begins by unpacking it.
#   SEEDS="6 7 8"    seeds, one run each
#   CALL=540         seconds that a call may take; the step at its end is finished, and a checkpoint written
#   LEARN_HEAD=      PRESET has no uncertainty head: one is learnt afterwards (preset uncertainty), FOLDER/PRESET-SEED-head
#   LIGHTDEPTH=...   the program, where it is not `lightdepth`
set -uo pipefail
preset=${1:?a preset of lightdepth train}
folder=${2:?a folder for the runs}
shift 2
program=${LIGHTDEPTH:-lightdepth}
ends=$((SECONDS + ${CALL:-540}))
[ -d "$folder" ] || { [ -f "$folder.tar.gz" ] && tar -xzf "$folder.tar.gz" -C "$(dirname "$folder")"; }
mkdir -p "$folder"

pack() { # the newest checkpoint is enough to go on from, and a run that is whole needs none
    local unneeded=() # rendered colons (.state) are made anew
    for run in "$folder"/*; do
        [ -f "$run/run.json" ] && unneeded+=("--exclude=$(basename "$folder")/$(basename "$run")/checkpoints")
    done
    tar -czf "$folder.tar.gz.new" -C "$(dirname "$folder")" "${unneeded[@]}" --exclude=last-previous.ckpt \
        --exclude=best.ckpt --exclude=.state "$(basename "$folder")" && mv "$folder.tar.gz.new" "$folder.tar.gz"
}

piece() { # the rest of one run, or as much of it as the call has time for
    local output=$1
    shift
    [ -f "$output/run.json" ] && return 0
    local left=$((ends - SECONDS))
    [ "$left" -gt 5 ] || return 75
    timeout --signal=TERM --kill-after=45 "$left" $program train -o "$output" --resume "$@"
    case $? in
        0) ;;
        124 | 137 | 143) return 75 ;;
        *) return 1 ;;
    esac
}

code=0
for seed in ${SEEDS:-6 7 8}; do
    run=$folder/$preset-$seed
    piece "$run" --preset "$preset" --seed "$seed" "$@" || { code=$?; break; }
    if [ -n "${LEARN_HEAD+set}" ]; then
        piece "$run-head" --preset uncertainty --seed "$seed" --model.start "$run/model.safetensors" \
            --data.tube.val_family variant ${HEAD_OPTIONS:-} || { code=$?; break; }
    fi
done
pack || code=1
case $code in
    0) echo "all is done: $folder.tar.gz" ;;
    75) echo "more is to do: call again" ;;
    *) echo "a run failed: see above" ;;
esac
exit $code
