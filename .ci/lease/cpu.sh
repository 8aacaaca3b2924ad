# On eight cores of the other half, the rest of which is left idle, once GPU 0's quiet time is over.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache CUDA_VISIBLE_DEVICES=
half=$(($(nproc --all) / 2))
left() { echo $(($(cat /tmp/repo/.ci/lease/asked) + 1640 - $(date +%s))); }
phases() { # POOL DEVICES: XLA's threads, of which pmt train takes 64 where one CPU makes several devices
  NPROC=$1 timeout 100 taskset -c "$half-$((half + 7))" python3 /tmp/repo/.ci/lease/phases.py "$2" 8 2>&1 | tail -1
}
lscpu | grep -E 'Thread|Core|Socket|NUMA'
while [ -e /tmp/runs/quiet-0 ] && [ "$(left)" -gt 1100 ]; do sleep 1; done
for pool in 64 8 32 16; do phases $pool 4; done
phases 8 1
timeout "$(left)" python3 -m bench measure workstation --threads 8 --out /tmp/runs/workstation_8.json | tail -1
timeout "$(left)" python3 -m bench measure workstation --threads 16 --out /tmp/runs/workstation_16.json | tail -1
