# On GPU 0 alone, before the queue takes it: how `pmt train` starts, and its rate with and without the multi-process service
# (one seed of 2,048 environments made 44,000 steps/s here once, 117,000 elsewhere).
export PYTHONPATH=/tmp/site:/tmp/repo CUDA_VISIBLE_DEVICES=0 PYTHONUNBUFFERED=1 XLA_PYTHON_CLIENT_PREALLOCATE=false
cores=$(nproc --all)
stamped() { # prints when each line was said, seconds after the start
  XDG_CACHE_HOME=/tmp/start/x WARP_CACHE_PATH=/tmp/start/w CUDA_CACHE_PATH=/tmp/start/c timeout 200 taskset -c "8-$((cores - 1))" \
    python3 -m pmt_jax train ant_2x4 --method mappo_l --num-envs 2048 --rollout-length 8 --steps 655360 --log-interval 1 --out "$(mktemp -d)/run" 2>&1 |
    python3 -c 'import sys, time; b = time.time(); [print(f"{time.time() - b:.1f}", line[:150].rstrip(), flush=True) for line in sys.stdin]'
}
stamped > /tmp/runs/start_cold.txt
stamped > /tmp/runs/start_warm.txt
(unset CUDA_MPS_PIPE_DIRECTORY && stamped) > /tmp/runs/start_alone.txt
rm -f /tmp/runs/quiet-0
