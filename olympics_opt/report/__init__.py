"""Reports: one self-contained HTML page from the files of a study, a verification or a solve."""
