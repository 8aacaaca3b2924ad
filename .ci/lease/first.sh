# On GPU 0 alone, before the queue takes it: how `pmt train` starts, then the peers.
export PYTHONPATH=/tmp/site:/tmp/repo:/tmp/extra CUDA_VISIBLE_DEVICES=0 PYTHONUNBUFFERED=1
cores=$(nproc --all)
stamped() { # prints when each line was said, seconds after the start
  XDG_CACHE_HOME=/tmp/start/x WARP_CACHE_PATH=/tmp/start/w CUDA_CACHE_PATH=/tmp/start/c timeout 200 taskset -c "8-$((cores - 1))" \
    python3 -m pmt_jax train ant_2x4 --method mappo_l --num-envs 2048 --rollout-length 8 --steps 32768 --log-interval 1 --verbose --out "$1" 2>&1 |
    python3 -c 'import sys, time; b = time.time(); [print(f"{time.time() - b:.1f}", line[:150].rstrip(), flush=True) for line in sys.stdin]'
}
timeout 300 taskset -c "8-$((cores - 1))" python3 -m bench measure start --out /tmp/runs/start.json
stamped /tmp/start/cold > /tmp/runs/start_cold.txt
stamped /tmp/start/warm > /tmp/runs/start_warm.txt
touch /tmp/runs/started
XLA_PYTHON_CLIENT_PREALLOCATE=false timeout 850 taskset -c 8-15 python3 -m bench peers --jaxmarl /tmp/jm --out /tmp/runs/peers.json
rm -f /tmp/runs/quiet-0
