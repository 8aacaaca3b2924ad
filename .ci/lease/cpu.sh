# Beside the queue, on the other half of the cores: where an update of one seed goes on 8 cores. Runs after setup.sh.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache NPROC=8
first=$(($(nproc --all) - 8))
phases() { timeout 100 taskset -c "$first-$((first + 7))" python3 /tmp/repo/.ci/lease/phases.py "$@" 2>&1 | tail -1; }
for devices in 1 2 4 8; do # they share the 8 threads
  phases $devices 8 /tmp/trace/$devices
  find /tmp/trace/$devices -name '*.json.gz' -exec cp {} /tmp/runs/trace-$devices.json.gz \; # host calls and waits
done
phases 2 16; phases 4 32 # as many threads for each device as there are cores, as before commit 9d2f517
phases 1 4; phases 2 4; phases 4 4
taskset -c "$first-$((first + 7))" python3 -m bench measure workstation --threads 8 --only "plain loop" --out /tmp/runs/plain_8.json
