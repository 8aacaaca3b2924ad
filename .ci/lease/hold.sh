# hold.sh SECONDS: waits until so many seconds after asking or until all runs have ended, says what runs, brings metrics home.
until [ $(($(date +%s) - $(cat /tmp/repo/.ci/lease/asked))) -ge "$1" ] || [ -e /tmp/runs/ended ]; do sleep 2; done
cat /tmp/runs/queue.out
for log in /tmp/runs/logs/*; do echo "$(basename "$log"): $(tail -c 200 "$log" | tr '\r' '\n' | tail -1)"; done
tail -60 /tmp/runs/cpu.out 2> /dev/null
nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
cd /tmp && tar cf - --exclude=checkpoints runs | xz -T8 -3 > "$OUT/runs.tar.xz"
