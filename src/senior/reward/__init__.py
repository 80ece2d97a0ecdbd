"""What people would say: the reward ensemble, its fit to answers, and Meta-Reward-Net's outer step."""
