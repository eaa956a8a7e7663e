"""Validation of settings. Errors name the field, its value and the allowed values. Loads neither JAX nor MuJoCo."""

from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin, get_type_hints

from mjx_dher.config import Config, HParams, Number, episodes_capacity, metadata, num_epochs, plain, steps_per_epoch
from mjx_dher.lookup import check_name

_INT32_MAX = 2**31 - 1  # counters on the device are int32


def check_devices(devices: Any) -> None:
    """Raises ValueError unless `devices` is a number of devices or "all". JAX checks later that they exist."""
    if devices != "all" and _number_problem("devices", devices, Number("[1, 1000000]"), int):
        raise ValueError(f"devices must be an integer in [1, 1000000], or all; got {devices!r}")


def host_and_port(name: str, value: str, allowed: str = "HOST:PORT") -> tuple[str, int]:
    """Splits "[::1]:8000" into a host, without brackets, and a port. Raises ValueError with the setting's `allowed` form."""
    host, _, port = value.rpartition(":")
    if not host or "/" in host or not (port.isascii() and port.isdecimal()) or not 0 < int(port[:6]) < 1 << 16:
        raise ValueError(f"{name} must be {allowed}; got {value!r}")
    return host.strip("[]"), int(port)


def check_plan(config: Config, episode_length: int, parts: int) -> None:
    """Raises ValueError for sizes that the environment's episodes do not allow, or that `parts` devices cannot share. It names
    each field and the nearest valid values.
    """
    episodes = episodes_capacity(config, episode_length)
    problems = []
    if 10 * config.total_steps < (epoch := steps_per_epoch(config, episode_length)):
        problems.append(
            f"total_steps must be at least {-(-epoch // 10)}, a tenth of an epoch (num_envs {config.num_envs} x"
            f" cycles_per_epoch {config.cycles_per_epoch} x {episode_length} steps), because runs have whole epochs; got"
            f" {config.total_steps}"
        )
    if config.n_step > episode_length:
        problems.append(f"n_step must lie in [1, {episode_length}], the steps of an episode; got {config.n_step}")
    for field, count, unit in (
        ("num_envs", config.num_envs, 1),
        ("batch_size", config.batch_size, 1),
        ("replay_size", episodes, episode_length),
    ):
        if count % parts:
            nearest = sorted({parts * max(1, count // parts), parts * (count // parts + 1)})
            allowed = " or ".join(str(unit * number) for number in nearest)
            kind = "a multiple of" if unit == 1 else f"whole episodes ({unit} steps), a multiple of"
            problems.append(
                f"{field} must be {kind} {parts}, the devices that share a run; got {getattr(config, field)}, the nearest"
                f" {'is' if len(nearest) == 1 else 'are'} {allowed}"
            )
    if problems:
        raise ValueError("\n".join(problems))


def check_all(*calls: tuple[Any, ...]) -> None:
    """Calls each (function, *arguments) and raises one ValueError with the messages of all that failed."""
    messages = []
    for function, *arguments in calls:
        try:
            function(*arguments)
        except ValueError as error:
            messages.append(str(error))
    if messages:
        raise ValueError("\n".join(messages))


def check_number(field: str, value: Any, interval: str, kind: type = int) -> None:
    """Raises ValueError, naming `field`, unless `value` is a number in an interval, such as "[0, 1)". A float may be an int."""
    if problem := _number_problem(field, value, Number(interval), kind):
        raise ValueError(problem)


def check_count(field: str, value: Any) -> None:
    """Raises ValueError unless `value` is an integer from 1 to a million."""
    check_number(field, value, "[1, 1000000]")


def check_seed(seed: Any) -> None:
    """Raises ValueError unless `seed` is one of a random key, 32 bits."""
    check_number("seed", seed, "[0, 4294967295]")


def validate(config: Config, hparams: HParams, episode_length: int | None) -> None:
    """Checks sizes and numbers of a run. Arrays of numbers, one per seed, are not checked, nor are sizes that depend on an
    episode's length without it. Raises ValueError with each invalid field, its value and the allowed values.
    """
    check_count("episode_length", 1 if episode_length is None else plain(episode_length))
    problems = [*_field_problems(config)] or [*_size_problems(config, episode_length)]
    problems += _field_problems(hparams)
    if problems:
        raise ValueError("\n".join(problems))


def delay_problem(config: Config, delay: int) -> str | None:
    """Error message if `target_period` or a learner's `policy_delay` does not fit the updates of a cycle, else None."""
    period, updates = config.target_period, config.updates_per_cycle
    if updates % period:
        divisors = [str(n) for n in range(1, updates + 1) if updates % n == 0]
        return f"target_period must divide updates_per_cycle ({updates}); got {period}, allowed: {', '.join(divisors)}"
    if period % delay and (delay % period or updates % delay):
        return (
            f"policy_delay must divide target_period ({period}), or be a multiple of it that divides updates_per_cycle"
            f" ({updates}); got {delay}"
        )
    return None


def _field_problems(settings: Config | HParams) -> Iterator[str]:
    """Problems of single fields."""
    hints = get_type_hints(type(settings))
    for name, number in metadata(type(settings), Number).items():
        value = getattr(settings, name)
        if name == "hidden_sizes":
            if not (isinstance(value, tuple) and 1 <= len(value) <= 100):
                yield f"{name} must be 1 to 100 integers in {number.interval}; got {value!r}"
            else:
                yield from filter(None, (_number_problem(name, size, number, int) for size in value))
        elif hasattr(value, "at") or getattr(value, "ndim", None):  # of JAX, perhaps traced, or one number for each run
            continue
        elif problem := _number_problem(name, value, number, hints[name]):
            yield problem
    for name, hint in hints.items():
        if get_origin(hint) is Literal:
            try:
                check_name(name, getattr(settings, name), get_args(hint))
            except ValueError as error:
                yield str(error)


def _number_problem(field: str, value: Any, number: Number, kind: type) -> str | None:
    value = value if hasattr(value, "at") else plain(value)  # JAX's can be traced
    allowed = (int,) if kind is int else (int, float)
    if isinstance(value, bool) or not isinstance(value, allowed):
        what = "an integer" if kind is int else "a number"
        return f"{field} must be {what} in {number.interval}; got {value!r}"
    return None if number.contains(value) else f"{field} must lie in {number.interval}; got {value!r}"


def _size_problems(c: Config, episode_length: int | None) -> Iterator[str]:
    """Problems of sizes that depend on each other."""
    if problem := delay_problem(c, c.policy_delay):
        yield problem
    if c.batch_size > c.replay_size:
        yield f"batch_size must not exceed replay_size ({c.replay_size}); got {c.batch_size}"
    period, delay = c.target_period, c.policy_delay
    at_once = max(period, delay)
    if c.batch_size * at_once > _INT32_MAX:
        yield (
            f"batch_size must not exceed {_INT32_MAX // at_once} with target_period {period} and policy_delay {delay}, because"
            f" the batches of {at_once} updates are drawn at once; got {c.batch_size}"
        )
    if episode_length is None:
        return
    cycle = c.num_envs * episode_length
    if c.replay_size < cycle:
        yield (
            f"replay_size must hold at least one cycle of {c.num_envs} episodes x {episode_length} steps = {cycle}"
            f" transitions; got {c.replay_size}"
        )
    epochs = num_epochs(c, episode_length)
    for field, count in (
        ("total_steps", epochs * steps_per_epoch(c, episode_length)),
        ("updates_per_cycle", epochs * c.cycles_per_epoch * c.updates_per_cycle),
    ):
        if count > _INT32_MAX:
            yield f"{field} must not make a run of more than {_INT32_MAX} steps or updates; got {count} in {epochs} epochs"
