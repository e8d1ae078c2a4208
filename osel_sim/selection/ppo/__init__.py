"""PPO: stable-baselines3's, the tuned one and the compiled replay."""
