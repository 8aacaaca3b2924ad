# Beside the queue, on the other half of the cores and after its programs have compiled.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache
half=$(($(nproc --all) / 2))
phases() { # POOL DEVICES: XLA's threads, of which pmt train takes 64 where one CPU makes several devices
  NPROC=$1 timeout 100 taskset -c "$half-$((half + 7))" python3 /tmp/repo/.ci/lease/phases.py "$2" 8 2>&1 | tail -1
}
sleep 120
for pool in 64 8 32 16; do phases $pool 4; done
phases 8 1
for threads in 8 "$half"; do
  timeout 650 python3 -m bench measure workstation --threads "$threads" --out "/tmp/runs/workstation_$threads.json" | tail -1
done
