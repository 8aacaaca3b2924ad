# On GPU 0 alone, before the queue takes it: how `pmt train` starts, and where a warm start spends its time.
export PYTHONPATH=/tmp/site:/tmp/repo CUDA_VISIBLE_DEVICES=0 PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
cores=$(nproc --all)
stamped() { # what python is given; prints when each line was said, seconds after the start
  XDG_CACHE_HOME=/tmp/start/x WARP_CACHE_PATH=/tmp/start/w CUDA_CACHE_PATH=/tmp/start/c timeout 200 taskset -c "8-$((cores - 1))" \
    python3 "$@" train ant_2x4 --method mappo_l --num-envs 2048 --rollout-length 8 --steps 32768 --log-interval 1 --out "$(mktemp -d)/run" 2>&1 |
    python3 -c 'import sys, time; b = time.time(); [print(f"{time.time() - b:.1f}", line[:150].rstrip(), flush=True) for line in sys.stdin]'
}
stamped -m pmt_jax > /tmp/runs/start_cold.txt
stamped -m pmt_jax > /tmp/runs/start_warm.txt
stamped -m cProfile -o /tmp/runs/start.prof -m pmt_jax > /tmp/runs/start_profile.txt
stamped -X importtime -m pmt_jax 2>&1 | sort -t '|' -k 2 -n | tail -60 > /tmp/runs/start_imports.txt
rm -f /tmp/runs/quiet-0
for flags in --xla_gpu_autotune_level=0 "--xla_gpu_autotune_level=0 --xla_gpu_enable_llvm_module_compilation_parallelism=true" \
  "--xla_gpu_autotune_level=0 --xla_llvm_disable_expensive_passes=true" "--xla_gpu_autotune_level=0 --xla_backend_optimization_level=1"; do
  XLA_FLAGS=$flags timeout 150 taskset -c "8-$((cores / 2 - 1))" python3 .ci/lease/xla_flags.py 2>&1 | tail -1
done
