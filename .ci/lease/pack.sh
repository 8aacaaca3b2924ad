# Packs what the lent machine lacks (it has JAX, flax, optax, orbax and chex): see README.md.
set -e
work=${1:-/tmp/pack}
python=$(ls "$HOME"/.pyenv/versions/3.12*/bin/python3.12 | tail -1)
mkdir -p "$work"
"$python" -m venv "$work/venv"
"$work/venv/bin/pip" install -q 'jax==0.11.2' 'mujoco==3.17.*' 'mujoco-mjx[warp]==3.17.*' 'warp-lang==1.18.0' 'brax>=0.14,<0.15' \
  rich shtab tomli-w trimesh glfw gymnasium pettingzoo psutil
here=$PWD
cd "$("$work/venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"
ls -d mujoco mujoco_mjx-* mujoco-3* warp warp_lang* brax brax-* rich rich-* trimesh trimesh-* jaxopt jaxopt-* ml_collections* \
  tensorboardX glfw glfw-* gymnasium gymnasium-* pettingzoo pettingzoo-* shtab shtab-* tomli_w* farama_notifications* psutil* |
  tar cf - --exclude=__pycache__ --exclude=warp-clang.so --exclude=mujoco/experimental --exclude=warp/tests --exclude=warp/examples \
    --exclude=mujoco/mjx/test_data --exclude='*.mp4' --exclude='_render_filament*' -T - | xz -T2 -9 > "$work/site.tar.xz"
cd "$here"
split -n 5 -a 1 "$work/site.tar.xz" "$work/part_"
for part in 1:a 2:b 3:c 4:d 5:e; do
  mkdir -p ".p${part%:*}"
  mv "$work/part_${part#*:}" ".p${part%:*}/${part#*:}"
done
ls -l .p[1-5]
