"""Random weights in the layout of a published OpenVLA-OFT folder, and a plain reading of those very tensors as a model.

`forward` shares no code with the library: it follows the published description of timm's towers, Llama and the heads.
"""

import json
import math

import torch
from safetensors.torch import save_file
from tokenizers import Tokenizer, models, pre_tokenizers
from torch.nn import functional

DINO, SIGLIP = "vision_backbone.featurizer.", "vision_backbone.fused_featurizer."
LLM = "language_model.model."
SIZES = {"dino": 32, "siglip": 24, "llm": 48, "layers": 3, "mlp": 40, "heads": (4, 2, 4)}
VOCAB, REGISTERS, GRID = 29952, 4, 2


def make_tensors():
    """Everything in the shards, under the published names."""
    torch.manual_seed(0)
    d, s, w = SIZES["dino"], SIZES["siglip"], SIZES["llm"]
    tensors = {DINO + "cls_token": (1, 1, d), DINO + "reg_token": (1, REGISTERS, d)}
    for prefix, dim, mlp in ((DINO, d, 4 * d), (SIGLIP, s, SIZES["mlp"])):
        tensors[prefix + "pos_embed"] = (1, GRID**2, dim)
        tensors |= linear(prefix + "patch_embed.proj", dim, 3, 14, 14) | norm(prefix + "norm", dim)
        for i in range(SIZES["layers"]):
            block = f"{prefix}blocks.{i}."
            tensors |= norm(block + "norm1", dim) | norm(block + "norm2", dim)
            tensors |= linear(block + "attn.qkv", 3 * dim, dim) | linear(block + "attn.proj", dim, dim)
            tensors |= linear(block + "mlp.fc1", mlp, dim) | linear(block + "mlp.fc2", dim, mlp)
            if prefix == DINO:
                tensors |= {block + "ls1.scale_factor": (dim,), block + "ls2.scale_factor": (dim,)}
    tensors |= linear(SIGLIP + "attn_pool.q", s, s)
    tensors |= linear("projector.fc1", 4 * (d + s), d + s) | linear("projector.fc2", w, 4 * (d + s))
    tensors |= linear("projector.fc3", w, w)
    tensors[LLM + "embed_tokens.weight"] = tensors["language_model.lm_head.weight"] = (VOCAB, w)
    tensors[LLM + "norm.weight"] = (w,)
    for i in range(SIZES["layers"]):
        layer = f"{LLM}layers.{i}."
        tensors |= {layer + f"self_attn.{c}_proj.weight": (w, w) for c in "qkvo"}
        tensors |= {layer + f"mlp.{name}_proj.weight": (64, w) for name in ("gate", "up")}
        tensors[layer + "mlp.down_proj.weight"] = (w, 64)
        tensors |= {layer + f"{name}_layernorm.weight": (w,) for name in ("input", "post_attention")}
    return {name: fill(shape) for name, shape in tensors.items()}


def make_heads():
    """The contents of both ``.pt`` files."""
    w = SIZES["llm"]
    head = norm("module.model.layer_norm1", 7 * w) | linear("module.model.fc1", w, 7 * w)
    for i in range(2):
        block = f"module.model.mlp_resnet_blocks.{i}.ffn."
        head |= norm(block + "0", w) | linear(block + "1", w, w)
    head |= norm("module.model.layer_norm2", w) | linear("module.model.fc2", 7, w)
    proprio = linear("module.fc1", w, 8) | linear("module.fc2", w, w)
    return [{name: fill(shape) for name, shape in part.items()} for part in (head, proprio)]


def linear(name, out, *shape):
    return {name + ".weight": (out, *shape), name + ".bias": (out,)}


def norm(name, dim):
    return {name + ".weight": (dim,), name + ".bias": (dim,)}


def fill(shape):
    """Weights that keep the scale of what they multiply."""
    return torch.randn(shape) / math.sqrt(math.prod(shape[1:]) or 1) if len(shape) > 1 else torch.randn(shape)


def write(folder, tensors, head, proprio):
    """The folder as published, with Python files that fail if anybody runs them."""
    names = sorted(tensors)
    shards = {"model-00001-of-00002.safetensors": names[::2], "model-00002-of-00002.safetensors": names[1::2]}
    for shard, part in shards.items():
        save_file({name: tensors[name].contiguous() for name in part}, folder / shard)
    weight_map = {name: shard for shard, part in shards.items() for name in part}
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    torch.save(head, folder / "action_head--150000_checkpoint.pt")
    torch.save(proprio, folder / "proprio_projector--150000_checkpoint.pt")
    text_config = {"model_type": "llama", "vocab_size": VOCAB, "pad_token_id": 32000}
    config = {"model_type": "openvla", "image_sizes": [28, 28], "text_config": text_config}
    config["auto_map"] = {"AutoModelForVision2Seq": "modeling_prismatic.OpenVLAForActionPrediction"}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "modeling_prismatic.py").write_text("raise SystemExit('executed')")
    (folder / "dataset_statistics.json").write_text(json.dumps({"libero_spatial_no_noops": statistics()}))
    (folder / "tokenizer.json").write_text(make_tokenizer())


def statistics():
    mask = [True] * 6 + [False]
    action = {"q01": [-0.5] * 6 + [0.0], "q99": [0.25] * 6 + [1.0], "mask": mask}
    return {"action": action, "proprio": {"q01": [-1.0] * 8, "q99": [3.0] * 8}, "num_transitions": 1}


def make_tokenizer():
    words = [
        "<unk>",
        "<s>",
        "</s>",
        *[
            "In",
            ":",
            "What",
            "action",
            "should",
            "the",
            "robot",
            "take",
            "to",
            "?",
            "Out",
            "pick",
            "up",
            "bowl",
        ],
        "\n",
    ]
    tokenizer = Tokenizer(models.WordLevel({word: i for i, word in enumerate(words)}, unk_token="<unk>"))
    steps = [pre_tokenizers.Split(" ", "removed"), pre_tokenizers.Punctuation()]
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([*steps, pre_tokenizers.Split("\n", "isolated")])
    return tokenizer.to_str()


# -- the plain reading -------------------------------------------------------------------------------------------------


def forward(tensors, head, proprio, pixels, state, ids, chunk=8):
    """Normalised actions [chunk, 7] of two images f32 [2, 3, 28, 28] in [0, 1], a normalised state [8] and the prompt's ids."""
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    dino = tower(tensors, DINO, (pixels - mean[:, None, None]) / std[:, None, None], SIZES["heads"][0])
    features = torch.cat([dino, tower(tensors, SIGLIP, pixels * 2 - 1, SIZES["heads"][1])], -1)
    x = functional.gelu(apply(tensors, "projector.fc1", features))
    visual = apply(tensors, "projector.fc3", functional.gelu(apply(tensors, "projector.fc2", x))).flatten(
        0, 1
    )
    proprio = {name.removeprefix("module."): value for name, value in proprio.items()}
    token = apply(proprio, "fc2", functional.gelu(apply(proprio, "fc1", state)))[None]
    embedding = tensors[LLM + "embed_tokens.weight"]
    slots = torch.zeros(chunk * 7, SIZES["llm"])
    x = torch.cat([embedding[[1]], visual, token, embedding[ids], slots, embedding[[2]]])
    x = llama(tensors, x)[-chunk * 7 - 2 : -2]  # the last prompt token and all slots but the last
    return action_head(head, x.reshape(chunk, -1))


def tower(tensors, prefix, pixels, heads):
    """Patch features after the second-to-last block."""
    t = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
    x = functional.conv2d(pixels, t["patch_embed.proj.weight"], t["patch_embed.proj.bias"], stride=14)
    x = x.flatten(2).transpose(1, 2) + t["pos_embed"]
    extra = [t[name].expand(2, -1, -1) for name in ("cls_token", "reg_token") if name in t]
    x = torch.cat([*extra, x], dim=1)
    for i in range(SIZES["layers"] - 1):
        b = f"blocks.{i}."
        y = layer_norm(t, b + "norm1", x)
        q, k, v = (part.unflatten(-1, (heads, -1)) for part in apply(t, b + "attn.qkv", y).chunk(3, -1))
        y = apply(t, b + "attn.proj", attend(q, k, v))
        x = x + y * t.get(b + "ls1.scale_factor", 1.0)
        y = apply(t, b + "mlp.fc2", functional.gelu(apply(t, b + "mlp.fc1", layer_norm(t, b + "norm2", x))))
        x = x + y * t.get(b + "ls2.scale_factor", 1.0)
    return x[:, -(GRID**2) :]


def llama(tensors, x):
    heads, size = SIZES["heads"][2], SIZES["llm"] // SIZES["heads"][2]
    angle = torch.arange(len(x))[:, None] / 10000 ** (torch.arange(0, size, 2) / size)
    cos, sin = (torch.cat([f(angle)] * 2, -1)[:, None] for f in (torch.cos, torch.sin))

    def rotate(y):
        left, right = y.chunk(2, -1)
        return y * cos + torch.cat([-right, left], -1) * sin

    for i in range(SIZES["layers"]):
        b = f"{LLM}layers.{i}."
        w = {name: tensors[f"{b}self_attn.{name}_proj.weight"] for name in "qkvo"}
        y = rms_norm(x, tensors[b + "input_layernorm.weight"])
        q, k, v = ((y @ w[name].T).unflatten(-1, (heads, size)) for name in "qkv")
        x = x + attend(rotate(q), rotate(k), v) @ w["o"].T
        y = rms_norm(x, tensors[b + "post_attention_layernorm.weight"])
        gate, up, down = (tensors[f"{b}mlp.{name}_proj.weight"] for name in ("gate", "up", "down"))
        x = x + (functional.silu(y @ gate.T) * (y @ up.T)) @ down.T
    return rms_norm(x, tensors[LLM + "norm.weight"])


def action_head(head, x):
    t = {name.removeprefix("module.model."): value for name, value in head.items()}
    x = functional.relu(apply(t, "fc1", layer_norm(t, "layer_norm1", x, 1e-5)))
    for i in range(2):
        b = f"mlp_resnet_blocks.{i}.ffn."
        x = x + functional.relu(apply(t, b + "1", layer_norm(t, b + "0", x, 1e-5)))
    return apply(t, "fc2", layer_norm(t, "layer_norm2", x, 1e-5))


def attend(q, k, v):
    """Attention of everything to everything; [..., S, heads, size] each."""
    logits = torch.einsum("...qhc,...khc->...hqk", q, k) / math.sqrt(q.shape[-1])
    return torch.einsum("...hqk,...khc->...qhc", logits.softmax(-1), v).flatten(-2)


def apply(tensors, name, x):
    return x @ tensors[name + ".weight"].T + tensors[name + ".bias"]


def layer_norm(tensors, name, x, eps=1e-6):
    return functional.layer_norm(x, x.shape[-1:], tensors[name + ".weight"], tensors[name + ".bias"], eps)


def rms_norm(x, weight):
    return x * torch.rsqrt((x * x).mean(-1, keepdim=True) + 1e-6) * weight
