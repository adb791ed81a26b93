"""``python -m mtjax.command.add_pretrained RUN ENV/AGENT``: add the policy of a run's first seed to the package's."""

from mtjax.command import process
from mtjax.names import InputError, command
from mtjax.saved import policy_files, pretrained


@command
def main(argv: list[str]) -> None:
    """Add the policy of a run to those of the package."""
    if len(argv) != 2 or argv[1].count("/") != 1:
        raise InputError("give a run and a name: python -m mtjax.command.add_pretrained RUN ENV/AGENT")
    run, name = argv
    target = pretrained.FOLDER / name
    if target.exists():
        raise InputError(f"there is a policy {name!r} already; remove {str(target)!r} first")
    policy_files.write(run, target)
    print(f"written to {target}: {sum(file.stat().st_size for file in target.iterdir()) / 1000:.0f} kB")


if __name__ == "__main__":
    process.main(main)
