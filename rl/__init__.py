"""How a policy learns a sport: PPO, its storage, checkpoints, training and evaluation.

Sample = one control step of one agent. Imports neither Drake nor CasADi.
"""
