"""Write motion.npz: the hopper at rest, its hip and knee swaying, for one second."""

from pathlib import Path

import mujoco
import numpy as np

_HERE = Path(__file__).parent
MOTION = _HERE / "motion.npz"


def main() -> None:
    model = mujoco.MjModel.from_xml_path(str(_HERE / "hopper.xml"))
    data = mujoco.MjData(model)
    fps = 50
    frames: dict[str, list] = {
        name: [] for name in ("joint_pos", "joint_vel", "body_pos_w", "body_quat_w")
    }
    for time in np.arange(fps) / fps:
        phase = 2.0 * np.pi * time
        data.qpos[7:] = 0.2 * np.sin(phase), -0.4 * np.sin(phase)
        mujoco.mj_forward(model, data)
        frames["joint_pos"].append(data.qpos[7:].copy())
        frames["joint_vel"].append(2.0 * np.pi * np.cos(phase) * np.array([0.2, -0.4]))
        frames["body_pos_w"].append(data.xpos[1:].copy())
        frames["body_quat_w"].append(data.xquat[1:].copy())
    arrays = {name: np.asarray(values, np.float32) for name, values in frames.items()}
    zeros = np.zeros_like(arrays["body_pos_w"])
    np.savez_compressed(
        MOTION, fps=np.array([fps]), body_lin_vel_w=zeros, body_ang_vel_w=zeros, **arrays
    )


if __name__ == "__main__":
    main()
