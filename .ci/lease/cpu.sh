# Eight of the 16 cores for one seed and plain loops, once the queue's programs have compiled; they have the others meanwhile.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu CUDA_VISIBLE_DEVICES= JAX_COMPILATION_CACHE_DIR=/tmp/cpu
cd /tmp/repo
lscpu | grep -E 'Model name|Thread|Core|Socket|NUMA'
lscpu -e=CPU,CORE | head -20 | tr '\n' ' '
queue() { pgrep -f 'queue_runs|pmt_jax' | xargs -n 1 taskset -acp "$1" > /dev/null 2>&1; } # and what the queue starts later
until [ "$(grep -l 'compiled in' /tmp/runs/logs/* | wc -l)" -ge 12 ] || [ $(($(date +%s) - $(cat .ci/lease/asked))) -ge 480 ]; do sleep 2; done
queue 0-7
phases() { # DEVICES: of one process on eight cores
  timeout 120 taskset -c 8-15 env NPROC=8 python3 .ci/lease/phases.py "$1" 8 2>&1 | tail -1
}
plain='
import time
from bench import plain
from bench.cases import Case
call = plain.plain_loop(Case("plain loop", "ant_2x4", threads=8))().call
call()
rates = []
for _ in range(7):
    begin = time.perf_counter()
    call()
    rates.append(8 * plain.STEPS / (time.perf_counter() - begin))
print("plain loops, 8:", sorted(round(x) for x in rates), "steps/s")
'
date +%s
for turn in 1 2; do
  phases 2
  timeout 60 taskset -c 8-15 python3 -c "$plain" | tail -1
  phases 4
  phases 1
  uptime
done
queue 0-15
date +%s
