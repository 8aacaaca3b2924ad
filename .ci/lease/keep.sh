# keep.sh 1, then keep.sh 2: checkpoints in parts of 16 MiB, four a call.
mkdir -p /tmp/parts && cd /tmp/parts
[ "$1" = 2 ] || tar cf - -C /tmp runs | xz -T16 -1 | split -b 15900000 - part
ls -l
ls | tail -n "+$((4 * $1 - 3))" | head -4 | xargs -I{} cp {} "$OUT/"
