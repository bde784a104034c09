#!/bin/sh
# Measure the tables that --speed and --budget read, lightning_modules/weights/x*.csv: sh benchmarks/trade_tables.sh [TABLE ...]
set -e
cd "$(dirname "$0")/.."
all="x1 x1_film x1_grey x1_grey_film x2 x2_film x3 x3_film x4 x4_film"
for name in ${*:-$all}; do
    set -- -c "configs/${name%%_*}.yaml"
    case $name in *_grey*) set -- "$@" -c configs/grey.yaml ;; esac
    case $name in
        x1* | *_grey*) set -- "$@" --data.motion 6 --data.bend 1.2 ;;
        *) set -- "$@" --data.motion 7.5 --data.rotation 2.5 --data.zoom 0.025 \
            -c '{model: {network: {init_args: {frames: 101}}}}' ;; # also for clips of 101 frames
    esac
    case $name in *_film) set -- "$@" --film 20 ;; esac
    lightning trade "$@" --data.val_clips 6 --rounds 3 -o "runs/tables/$name"
    cp "runs/tables/$name/trade.csv" "lightning_modules/weights/$name.csv"
done
