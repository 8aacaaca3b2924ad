# Beside the queue, on the other half of the cores and after its programs have compiled.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache
first=$(($(nproc --all) / 2))
sleep 120
for pool in 64 8 32 16; do # XLA's threads: pmt train takes 64 where one CPU makes several devices
  NPROC=$pool timeout 100 taskset -c "$first-$((first + 7))" python3 /tmp/repo/.ci/lease/phases.py 4 8 2>&1 | tail -1
done
NPROC=8 timeout 100 taskset -c "$first-$((first + 7))" python3 /tmp/repo/.ci/lease/phases.py 1 8 2>&1 | tail -1
for threads in 8 "$first"; do
  timeout 650 python3 -m bench measure workstation --threads "$threads" --out "/tmp/runs/workstation_$threads.json" | tail -1
done
