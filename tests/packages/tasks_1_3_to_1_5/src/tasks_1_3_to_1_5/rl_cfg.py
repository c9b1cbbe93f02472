"""Learners, written by position where release 1.5 takes positions."""

from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg

_GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}


def make_rl_cfg(experiment_name: str) -> RslRlOnPolicyRunnerCfg:
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg((16, 16), "elu", True, distribution_cfg=_GAUSSIAN),
        critic=RslRlModelCfg((16, 16), "elu", True),
        algorithm=RslRlPpoAlgorithmCfg(2, 1),
        experiment_name=experiment_name,
    )


def make_recurrent_rl_cfg(experiment_name: str) -> RslRlOnPolicyRunnerCfg:
    network = {"hidden_dims": (16,), "rnn_type": "lstm", "rnn_hidden_dim": 8}
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(**network, class_name="RNNModel", distribution_cfg=_GAUSSIAN),
        critic=RslRlModelCfg(**network, class_name="RNNModel"),
        algorithm=RslRlPpoAlgorithmCfg(num_mini_batches=1),
        experiment_name=experiment_name,
    )
