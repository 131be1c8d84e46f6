from .policy import is_lerobot as is_lerobot, read_lerobot as read_lerobot
