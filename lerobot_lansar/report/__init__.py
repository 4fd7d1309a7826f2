"""Success rates of an evaluation on the CALVIN desk.

Reads files only, local or from the hub: no simulation, no policy, no LeRobot.

report      `lansar-report`: report.json, report.md and the plots
results     `eval_info.json` and `episodes.jsonl` to episodes, and episodes to success rates
policy      what the files beside a policy say: its inputs, the look that it was trained on
plots       the plots
"""
