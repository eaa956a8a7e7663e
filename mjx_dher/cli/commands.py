"""The commands by name, and where each is."""

# Each command, and the function (argv, console) -> exit status. Beside it is the class of its arguments: EvalArgs of eval.
COMMANDS = {
    "train": "mjx_dher.cli.train:train_command",
    "resume": "mjx_dher.cli.train:resume_command",
    "eval": "mjx_dher.cli.evaluate:eval_command",
    "render": "mjx_dher.cli.render:render_command",
    "view": "mjx_dher.cli.view:view_command",
    "demo": "mjx_dher.cli.view:demo_command",
    "transfer": "mjx_dher.cli.transfer:transfer_command",
    "export": "mjx_dher.cli.export:export_command",
    "sweep": "mjx_dher.cli.sweep:sweep_command",
    "plot": "mjx_dher.cli.plot:plot_command",
    "report": "mjx_dher.cli.report:report_command",
    "list": "mjx_dher.cli.listing:list_command",
    "check": "mjx_dher.cli.check:check_command",
    "doctor": "mjx_dher.cli.doctor:doctor_command",
    "completion": "mjx_dher.cli.completion:completion_command",
}
