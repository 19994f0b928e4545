"""What a person does with it: the command line, the study, verification, reports and pictures."""
