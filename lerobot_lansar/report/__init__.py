"""What evaluations on the CALVIN desk and trainings have shown: tables, plots, a page, a model card.

Reads files only, local or from the hub: no simulation, no policy, no LeRobot.

report       `lansar-report`: report.json, report.md and report.html
options      its options
episodes     the files in an evaluation's folder, to episodes
evaluation   folders to evaluations: what is merged, what is missing, where the videos are
figures      episodes to success rates, intervals, paired differences
policy       what the files beside a policy say: its inputs, the look that it was trained on
published    published results, to print beside one's own
tables       evaluations and their figures to the tables of report.json
notes        what a reader must know beside the figures
curves       losses of trainings
cells        what stands in the tables' cells
markdown     report.md
plots        the plots
page         report.html, with its template, style and script in page_files/
hub          results in a model card on the hub
"""
