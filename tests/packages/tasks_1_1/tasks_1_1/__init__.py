"""Two tasks for release 1.1: a crawler that walks and a cart that balances a pole."""

from mjlab.tasks.registry import register_mjlab_task

from . import names as names
from .cart import cart_env_cfg, cart_rl_cfg
from .crawler import CrawlerRunner, crawler_env_cfg, crawler_rl_cfg

register_mjlab_task(
    task_id="Tasks11-Cart",
    env_cfg=cart_env_cfg(),
    play_env_cfg=cart_env_cfg(play=True),
    rl_cfg=cart_rl_cfg(),
)
register_mjlab_task(
    task_id="Tasks11-Crawler",
    env_cfg=crawler_env_cfg(),
    play_env_cfg=crawler_env_cfg(play=True),
    rl_cfg=crawler_rl_cfg(),
    runner_cls=CrawlerRunner,
)
