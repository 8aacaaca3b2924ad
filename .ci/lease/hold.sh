# hold.sh SECONDS: waits until so many seconds after asking or until all runs have ended, says what runs, brings metrics home.
until [ $(($(date +%s) - $(cat /tmp/repo/.ci/lease/asked))) -ge "$1" ] || [ -e /tmp/runs/ended ]; do sleep 2; done
cat /tmp/runs/queue.out
for log in /tmp/runs/logs/*; do echo "$(basename "$log"): $(tail -c 200 "$log" | tr '\r' '\n' | tail -1)"; done
nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
cd /tmp && tar cf - --exclude=checkpoints runs | xz -T8 -3 > "$OUT/runs.tar.xz"
# Policies apart, each once, when its run has ended.
ended=$(grep -ls '^done:' /tmp/runs/logs/{velocity-*-{happo,mappo_l,f4sg,f4sg-pid},walls*} | sed -E 's,/logs/([a-z0-9_]+)-,/runs/\1/,')
[ -z "$ended" ] || JAX_PLATFORMS=cpu PYTHONPATH=/tmp/site:/tmp/repo python3 /tmp/repo/.ci/lease/policies.py "$OUT" $ended
