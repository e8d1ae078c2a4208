"""Three live decisions between a policy file and a policy object of one's own."""

import numpy as np

import osel_sim as osel


class StandStill:
    def reset(self, instruction: str) -> None:
        self.instruction = instruction

    def act(self, observation: dict) -> np.ndarray:
        return np.zeros((8, 7), np.float32)  # eight actions: no motion, fingers as they are


still = osel.as_policy(StandStill(), cameras=["agentview"])
result = osel.run(task="lift", policies=["local_small", still], selector="thompson", episodes=3, out="runs/own_policy")
print(result.decisions[["instruction", "policy", "success", "steps", "reward"]])
