# hold.sh SECONDS: waits until so many seconds after asking or until all runs have ended, says what runs, brings metrics home.
until [ $(($(date +%s) - $(cat /tmp/repo/.ci/lease/asked))) -ge "$1" ] || [ -e /tmp/runs/ended ]; do sleep 2; done
cat /tmp/runs/queue.out
for log in /tmp/runs/logs/*; do echo "$(basename "$log"): $(tail -c 200 "$log" | tr '\r' '\n' | tail -1)"; done
nvidia-smi --query-gpu=utilization.gpu,memory.used --format=csv,noheader
cd /tmp && tar cf - --exclude=checkpoints runs | xz -T8 -3 > "$OUT/runs.tar.xz"
# Policies apart and once, the newest checkpoint alone: an archive that is too large stays there, and the metrics must not
# stay with it. Five seeds of a half cheetah have 12 MB: four policies a call.
sent=0
for run in $(cd /tmp && ls -d runs/runs/velocity/*-{happo,mappo_l,f4sg} 2> /dev/null); do
  name=$(basename "$run")
  if [ $sent -lt 4 ] && grep -q '^done:' "/tmp/runs/logs/velocity-$name" && mkdir "/tmp/sent-$name" 2> /dev/null; then
    sent=$((sent + 1))
    newest=$(ls "/tmp/$run/checkpoints" | sort -n | tail -1)
    tar cf - -C /tmp "$run"/{config.toml,versions.json,metrics.jsonl} "$run/checkpoints/$newest" | xz -T8 -1 > "$OUT/$name.tar.xz"
  fi
done
