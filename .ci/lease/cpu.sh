# On eight cores of the other half, the rest of which is left idle.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache CUDA_VISIBLE_DEVICES=
half=$(($(nproc --all) / 2))
phases() { # POOL DEVICES: XLA's threads, of which pmt train takes two a device, or one a core if these are more
  NPROC=$1 timeout 100 taskset -c "$half-$((half + 7))" python3 /tmp/repo/.ci/lease/phases.py "$2" 8 2>&1 | tail -1
}
lscpu | grep -E 'Thread|Core|Socket|NUMA'
for turn in 1 2 3; do
  phases 8 4
  phases 64 4
  phases 16 8
  phases 8 2
  phases 8 1
  echo "each product on one thread" && XLA_FLAGS=--xla_cpu_multi_thread_eigen=false phases 8 4
done
# It waits up to 20 s a turn for other work to pause, seven times.
timeout 300 taskset -c "$half-$((half + 7))" python3 -m bench measure workstation --only "plain" --out /tmp/runs/plain_8.json | tail -1
