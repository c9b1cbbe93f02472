"""Speed of `env.step` and memory as the number of environments grows."""

from __future__ import annotations

from measure import Row, show
from stepping import NUM_THREADS, Stepper, median_times

BASE = 1024
NUMBERS = (256, 4096, 16384)
TASKS = (
    ("cartpole", "Mjlab-Cartpole-Swingup", 200_000),
    ("Go1 flat", "Mjlab-Velocity-Flat-Unitree-Go1", 16_384),
)
MEMORY_AT = 4096
TO_REACH = 0.85


def measure() -> list[Row]:
    """Measure both tasks."""
    rows = []
    for name, task, samples in TASKS:
        steppers = [Stepper(task, number) for number in (BASE, *NUMBERS)]
        base, *others = median_times(steppers, samples, repeats=9)
        rate = BASE / base
        for stepper, seconds in zip(steppers[1:], others, strict=True):
            number = stepper.num_envs
            ratio = number / seconds / rate
            rows.append(
                Row(
                    f"{name}, native, {NUM_THREADS} threads: env-steps/s at {number:,} environments "
                    f"over those at {BASE:,}",
                    f"{ratio:.2f} ({number / seconds:,.0f} env-steps/s)",
                    f"{BASE:,} environments: {rate:,.0f} env-steps/s",
                    f"at least {TO_REACH}",
                    ratio >= TO_REACH,
                )
            )
            if number == MEMORY_AT:
                rows.append(
                    Row(
                        f"{name}: memory that {number:,} environments take",
                        f"{stepper.memory / 2**20:,.0f} MiB",
                        f"{BASE:,} environments: {steppers[0].memory / 2**20:,.0f} MiB",
                        "",
                        None,
                    )
                )
        for stepper in steppers:
            stepper.close()
    return rows


if __name__ == "__main__":
    print(show(measure()))
