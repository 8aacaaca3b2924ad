# Beside the queue, on the other half of the cores and after its programs have compiled: 8 cores, then all of the half.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache
sleep 120
for threads in 8 $(($(nproc --all) / 2)); do
  timeout 650 python3 -m bench measure workstation --threads "$threads" --out "/tmp/runs/workstation_$threads.json" | tail -1
done
