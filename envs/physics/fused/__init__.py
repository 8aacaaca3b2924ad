"""The engine `fused`: a whole control step compiled for one model, from tables of its MjModel.

`model` derives the tables and says what cannot be stepped. The C++ headers hold MuJoCo's formulas once, for two
schedules: a world a SIMD lane on CPUs (`cpu`, lanes*.h), and a warp a world on NVIDIA GPUs.
"""
