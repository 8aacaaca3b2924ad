# Beside the queue, on the other half of the cores: where an update of one seed goes on 8 cores. Runs after setup.sh.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache
first=$(($(nproc --all) - 8))
for threads in 8 4 2 1; do
  for devices in 1 2 4; do
    NPROC=4 timeout 100 taskset -c "$first-$((first + 7))" python3 /tmp/repo/.ci/lease/phases.py "$devices" "$threads" 2>&1 | tail -1
  done
done
taskset -c "$first-$((first + 7))" python3 -m bench measure workstation --threads 8 --only "plain loop" --out /tmp/runs/plain_8.json
