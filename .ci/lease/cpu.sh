# Beside the queue, on the other half of the cores: where an update of one seed goes on 8 cores. Runs after setup.sh.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache
first=$(($(nproc --all) - 8))
for pair in "1 8" "2 4" "4 2" "2 8" "4 8" "1 4" "2 2" "4 1" "8 1"; do
  NPROC=4 timeout 100 taskset -c "$first-$((first + 7))" python3 /tmp/repo/.ci/lease/phases.py $pair "/tmp/trace/${pair/ /-}" 2>&1 | tail -1
done
taskset -c "$first-$((first + 7))" python3 -m bench measure workstation --threads 8 --only "plain loop" --out /tmp/runs/plain_8.json
for pair in 1-8 2-4 4-2; do cp "$(find /tmp/trace/$pair -name '*.json.gz')" /tmp/runs/trace-$pair.json.gz; done # host calls and waits
