# On the lent machine, in the tree's root: unpacks, checks that all is there, starts the queue in a session of its own.
set -e
mkdir -p /tmp/site /tmp/repo /tmp/runs /tmp/mps /tmp/mpslog
cat /tmp/[a-e] | tar xJ -C /tmp/site
unset PYTHONDONTWRITEBYTECODE # as where pip has installed it
python3 -m compileall -q -j 8 /tmp/site > /dev/null 2>&1 || true
[ ! -e /tmp/z ] || tar xJf /tmp/z -C / # runs that an earlier lease began
cp -r pmt_jax envs configs bench .ci pyproject.toml /tmp/repo/
nvidia-smi --query-gpu=name --format=csv,noheader | tee /tmp/runs/gpus
export CUDA_MPS_PIPE_DIRECTORY=/tmp/mps CUDA_MPS_LOG_DIRECTORY=/tmp/mpslog PYTHONPATH=/tmp/site:/tmp/repo
nvidia-cuda-mps-control -d
cd /tmp/repo
python3 -m pmt_jax --help > /dev/null
python3 -m bench list > /dev/null
# `ended` also if the queue itself breaks: nobody should wait for it then.
setsid bash -c "python3 .ci/lease/queue_runs.py; touch /tmp/runs/ended" > /tmp/runs/queue.out 2>&1 &
