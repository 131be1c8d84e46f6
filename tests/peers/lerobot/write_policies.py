"""Let the real LeRobot write small policies of random weights, with what it answers. Run in LeRobot's environment.

    python write_policies.py FOLDER [NAME ...]

Each policy's folder is what ``save_pretrained`` wrote, with CLIP's configuration and tokenizer as ``clip``, and
``reference.safetensors``: observations, the condition, all noise in the order in which it was drawn, and the executed chunk
before and after the postprocessor.
"""

import json
import shutil
import sys
from pathlib import Path

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.factory import make_pre_post_processors
from lerobot.policies.multi_task_dit.configuration_multi_task_dit import MultiTaskDiTConfig
from lerobot.policies.multi_task_dit.modeling_multi_task_dit import MultiTaskDiTPolicy
from safetensors.torch import save_file
from tokenizers import Tokenizer, models, pre_tokenizers, processors
from transformers import CLIPConfig, CLIPModel, PreTrainedTokenizerFast

TASKS = ["push the red cube", "pick it", "push the red cube"]
WORDS = ["<s>", "<e>", "push", "the", "red", "cube", "pick", "it", "blue"]

# Entries that differ from those below; in "size" height and width of images, in "cameras" their number.
VARIANTS = {
    "diffusion": {},
    "flow": {"objective": "flow_matching", "num_integration_steps": 7, "use_rope": False, "separate": True,
             "use_positional_encoding": True},
    "flow_both": {"objective": "flow_matching", "use_positional_encoding": True, "rope_base": 500.0, "sigma_min": 0.1,
                  "image_resize_shape": (18, 20)},
    "sample_ddim": {"noise_scheduler_type": "DDIM", "prediction_type": "sample", "num_inference_steps": 10},
    "noclip": {"clip_sample": False, "num_inference_steps": 5, "use_rope": False, "num_train_timesteps": 50},
    "stateless": {"cameras": 0, "n_obs_steps": 1, "noise_scheduler_type": "DDIM", "num_inference_steps": 9,
                  "clip_sample_range": 3.0},
    "quantiles": {"modes": {"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILE10"}, "n_obs_steps": 3,
                  "objective": "flow_matching", "num_integration_steps": 3},
    "mean_std": {"modes": {"VISUAL": "MIN_MAX", "STATE": "MEAN_STD", "ACTION": "MEAN_STD"}, "size": (16, 16),
                 "num_inference_steps": 3, "clip_sample_range": 20.0},
}  # fmt: skip


def make_clip(folder: Path) -> None:
    tower = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    ids = {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    text = tower | ids | {"vocab_size": len(WORDS), "max_position_embeddings": 12}
    CLIPModel(
        CLIPConfig(
            text_config=text, vision_config=tower | {"image_size": 16, "patch_size": 8}, projection_dim=8
        )
    ).save_pretrained(folder)
    tokenizer = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<e>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(
        single="<s> $A <e>", special_tokens=[("<s>", 0), ("<e>", 1)]
    )
    PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, bos_token="<s>", eos_token="<e>", pad_token="<e>", unk_token="<e>"
    ).save_pretrained(folder)
    tokenizer.save(str(folder / "tokenizer.json"))


def write(folder: Path, name: str, clip: Path) -> None:
    torch.manual_seed(sorted(VARIANTS).index(name))
    changes = dict(VARIANTS[name])
    size, cameras = changes.pop("size", (18, 20)), ["top", "wrist"][: changes.pop("cameras", 2)]
    separate, modes = changes.pop("separate", False), changes.pop("modes", None)
    features = {"observation.state": PolicyFeature(FeatureType.STATE, (5,))}
    features |= {f"observation.images.{c}": PolicyFeature(FeatureType.VISUAL, (3, *size)) for c in cameras}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (3,))}
    fixed = {"horizon": 8, "n_action_steps": 5, "hidden_dim": 16, "num_layers": 2, "num_heads": 2}
    fixed |= {"timestep_embed_dim": 8, "image_crop_shape": (16, 16), "tokenizer_max_length": 12}
    if modes is not None:
        fixed["normalization_mapping"] = modes
    config = MultiTaskDiTConfig(
        input_features=features, output_features=outputs, device="cpu", vision_encoder_name=str(clip),
        text_encoder_name=str(clip), use_separate_rgb_encoder_per_camera=separate, push_to_hub=False, **fixed | changes,
    )  # fmt: skip
    policy = MultiTaskDiTPolicy(config).eval()
    with torch.no_grad():  # blocks are made to add nothing, towers alike
        for key, weight in policy.named_parameters():
            weight.add_(torch.randn_like(weight) * (0.2 if "adaLN" in key else 0.05))
        policy.noise_predictor.output_proj.weight.mul_(0.3)
    stats = {key: statistics(feature.shape) for key, feature in {**features, **outputs}.items()}
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    for file in ("config.json", "tokenizer.json"):
        (folder / "clip").mkdir(exist_ok=True)
        shutil.copy(clip / file, folder / "clip" / file)
    rename_clip(folder, str(clip))
    constant = stats["observation.state"]["min"][3]
    save_file(answer(policy, before, after, features, constant), folder / "reference.safetensors")


def statistics(shape: tuple[int, ...]) -> dict[str, torch.Tensor]:
    one = (3, 1, 1) if len(shape) == 3 else shape
    mean, std = torch.randn(one) if len(shape) == 1 else torch.rand(one), 0.3 + torch.rand(one)
    found = {"mean": mean, "std": std, "min": mean - 2 * std, "max": mean + 2 * std, "q01": mean - std}
    found |= {"q99": mean + std, "q10": mean - 0.7 * std, "q90": mean + 0.9 * std, "q50": mean}
    if shape == (5,):
        found["max"][3] = found["min"][3]  # a dimension that never changed
    return {key: value.contiguous() for key, value in found.items()}


def rename_clip(folder: Path, clip: str) -> None:
    """Name CLIP's folder as it lies beside the policy."""
    for file in folder.glob("*.json"):
        file.write_text(file.read_text().replace(json.dumps(clip), '"clip"'))


def answer(policy, before, after, features, constant) -> dict[str, torch.Tensor]:
    steps = policy.config.n_obs_steps
    raw = {
        key: torch.rand(3, steps, *feature.shape)
        if len(feature.shape) == 3
        else torch.randn(3, steps, *feature.shape)
        for key, feature in features.items()
    }
    raw["observation.state"][..., 3] = constant
    drawn, draw = [], torch.randn

    def recorded(*args, **kwargs):
        drawn.append(draw(*args, **kwargs))
        return drawn[-1]

    shown = [
        before({**{key: value[:, step] for key, value in raw.items()}, "task": TASKS})
        for step in range(steps)
    ]
    batch = shown[-1] | {key: torch.stack([one[key] for one in shown], dim=1) for key in features}
    images = [batch[key] for key in features if "images" in key]
    if images:
        batch["observation.images"] = torch.stack(images, dim=2)
    with torch.no_grad():
        condition = policy.observation_encoder.encode(batch)
        torch.randn = recorded  # diffusers draws with it too
        try:
            chunk = policy._generate_actions(batch)
        finally:
            torch.randn = draw
    tensors = {
        **raw,
        "cond": condition,
        "noise": torch.stack(drawn, dim=1),
        "chunk": chunk,
        "action": after(chunk),
    }
    return {key: value.contiguous() for key, value in tensors.items()}


if __name__ == "__main__":
    target = Path(sys.argv[1]).resolve()
    make_clip(target / "clip_made")
    for variant in sys.argv[2:] or VARIANTS:
        write(target / variant, variant, target / "clip_made")
        print(variant, flush=True)
