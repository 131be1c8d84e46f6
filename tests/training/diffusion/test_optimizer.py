from torchrl_sparse.networks.diffusion.transformer import TransformerForDiffusion
from torchrl_sparse.training.diffusion.optimizer import optimizer_groups


def test_only_linear_and_attention_weights_decay():
    network = TransformerForDiffusion(
        input_dim=3, output_dim=3, horizon=6, n_obs_steps=2, cond_dim=5, n_layer=1, n_head=2, n_emb=16
    )
    names = {id(parameter): name for name, parameter in network.named_parameters()}
    decay, free = optimizer_groups(network, 1e-3)
    assert (decay["weight_decay"], free["weight_decay"]) == (1e-3, 0.0)
    decayed = {names[id(p)] for p in decay["params"]}
    assert len(decayed) + len(free["params"]) == len(names)
    assert all(name.endswith("weight") and "norm" not in name and "ln_f" not in name for name in decayed)
    assert {"decoder.layers.0.self_attn.in_proj_weight", "head.weight", "encoder.0.weight"} <= decayed
    assert {"pos_emb", "cond_pos_emb"} <= {names[id(p)] for p in free["params"]}
