"""The command line: ``torchrl-athletic diagnose --help`` and ``fit --help``, or ``python -m torchrl_athletic``."""

from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> None:
    """Run the subcommand that the arguments name.

    Args:
        args: What stands after the program's name; by default that of this process.
    """
    import tyro

    # these bring MuJoCo, which the import of this module must not
    from torchrl_athletic.diagnosis import command, fit_command

    config = tyro.extras.subcommand_cli_from_dict(
        {"diagnose": command.Config, "fit": fit_command.FitConfig},
        prog="torchrl-athletic",
        description="Find out why a MuJoCo simulation and a real robot disagree.",
        args=args,
    )
    if isinstance(config, fit_command.FitConfig):
        fit_command.main(config)
    elif config.uan:
        from torchrl_athletic.training import learn_remainder  # brings TorchRL, which a diagnosis does without

        command.main(config, learn_remainder)
    else:
        command.main(config)


if __name__ == "__main__":
    main()
