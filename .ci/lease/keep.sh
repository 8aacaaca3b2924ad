# keep.sh N: the newest checkpoints of runs that can go on, in parts of 16 MiB: the N-th four of them.
mkdir -p /tmp/parts && cd /tmp/parts
if [ "$1" = 1 ]; then
  for run in $(grep -hao '[^ ]* --resume' /tmp/runs/logs/* | cut -d ' ' -f 1 | sort -u); do
    printf '%s\n' "$run"/{config.toml,versions.json,metrics.jsonl} "$run/checkpoints/$(ls "$run/checkpoints" | sort -n | tail -1)"
  done | tar cf - -T - | xz -T0 -1 | split -b 15900000 - part
fi
ls -l
ls | tail -n "+$((4 * $1 - 3))" | head -4 | xargs -I{} cp {} "$OUT/"
