#!/bin/sh
# Train networks on a GPU one after another: sh benchmarks/train_queue.sh PICTURES OUTPUT [MINUTES [ARGUMENT ...]]
# Large networks train for MINUTES, small ones for half as long. Repeat the command to resume interrupted runs; the time so
# far counts. The results are OUTPUT/NAME/weights.safetensors.
set -e
pictures=$1 output=$2 minutes=${3:-4}
[ -d "$pictures" ] && [ -n "$output" ] || { sed -n 2,4p "$0"; exit 2; }
shift $(( $# < 3 ? $# : 3 ))

# NAME SECONDS CONFIGURATION ...
train() {
    name=$1 seconds=$2
    shift 2
    last=$output/$name/checkpoints/last.ckpt
    [ ! -f "$last" ] || set -- "$@" --ckpt_path "$last"
    lightning fit "$@" -o "$output/$name" --data.root "$pictures" \
        --trainer.max_time "$(printf 00:%02d:%02d:%02d $(( seconds / 3600 )) $(( seconds / 60 % 60 )) $(( seconds % 60 )))"
}

seconds=$(( minutes * 60 ))
configs=$(dirname "$0")/../configs
train grey_large_x1 $seconds -c "$configs/x1.yaml" -c "$configs/grey.yaml" -c "$configs/cameras.yaml" \
    -c "$configs/gpu.yaml" --model.network.size large_x1 "$@"
train grey_small_x1 $(( seconds / 2 )) -c "$configs/x1.yaml" -c "$configs/grey.yaml" -c "$configs/cameras.yaml" \
    -c "$configs/gpu.yaml" --model.network.size small_x1 "$@"
# corrections for noisy sensors, trained alone, to replace the weights named "noisy"
fixed='[representation,refinement,reconstruction.refine,reconstruction.fuse,reconstruction.end,reconstruction.rgb,fusion]'
train noise_x4 $(( seconds / 2 )) -c "$configs/x4.yaml" -c "$configs/cameras.yaml" -c "$configs/gpu.yaml" \
    --model.network.size huge --model.network.noise_blocks 8 --model.frozen "$fixed" --model.weights cscsr_huge_x4 "$@"
train noise_long_x4 $(( seconds / 2 )) -c "$configs/x4.yaml" -c "$configs/cameras.yaml" -c "$configs/gpu.yaml" \
    --model.network.size huge --model.network.frames 101 --model.network.noise_blocks 8 --model.frozen "$fixed" \
    --model.weights cscsr_huge_long_x4 "$@"
train large_x4 $seconds -c "$configs/x4.yaml" -c "$configs/cameras.yaml" -c "$configs/gpu.yaml" \
    --model.network.size huge "$@"
train small_x4 $(( seconds / 2 )) -c "$configs/x4.yaml" -c "$configs/cameras.yaml" \
    -c "$configs/gpu.yaml" --model.network.size small "$@"
