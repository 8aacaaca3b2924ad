# hold.sh SECONDS: waits until so many seconds after asking or until all runs have ended, says what runs, brings metrics home.
until [ $(($(date +%s) - $(cat /tmp/repo/.ci/lease/asked))) -ge "$1" ] || [ -e /tmp/runs/ended ]; do sleep 2; done
cat /tmp/runs/queue.out
for log in /tmp/runs/logs/*; do echo "$(basename "$log"): $(tail -c 200 "$log" | tr '\r' '\n' | tail -1)"; done
tail -n 25 /tmp/runs/first.out /tmp/runs/start_*.txt /tmp/runs/cpu.out 2> /dev/null | cut -c 1-300
nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
cd /tmp && tar cf - --exclude='runs/limits/*/checkpoints' --exclude='.group-*/run/checkpoints' runs | xz -T8 -3 > "$OUT/runs.tar.xz"
