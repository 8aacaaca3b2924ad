# On eight cores of the other half, the rest of which is left idle, once GPU 0's quiet time is over.
export PYTHONPATH=/tmp/site:/tmp/repo JAX_PLATFORMS=cpu XDG_CACHE_HOME=/tmp/cache CUDA_VISIBLE_DEVICES=
half=$(($(nproc --all) / 2))
phases() { # POOL DEVICES: XLA's threads, of which pmt train takes 64 where one CPU makes several devices
  NPROC=$1 timeout 100 taskset -c "$half-$((half + 7))" python3 /tmp/repo/.ci/lease/phases.py "$2" 8 2>&1 | tail -1
}
lscpu | grep -E 'Thread|Core|Socket|NUMA'
while [ -e /tmp/runs/quiet-0 ]; do sleep 1; done
# Beside it the rows gathered as before: three exchanges between devices a minibatch more.
mkdir -p /tmp/before && cp -r /tmp/repo/. /tmp/before
sed -i -e 's/, sharding.replicate(rows)))/, rows))/' -e 's/^    count = jax.tree/    rows = sharding.replicate(rows)\n&/' /tmp/before/pmt_jax/learning/optimise.py
for turn in 1 2 3; do
  for tree in /tmp/before /tmp/repo; do echo $tree && PYTHONPATH=/tmp/site:$tree phases 64 4; done
  phases 64 8
  phases 64 2
  phases 8 1
done
timeout 240 python3 -m bench measure workstation --threads 8 --only "plain" --out /tmp/runs/plain_8.json | tail -1
