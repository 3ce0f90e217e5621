"""Trust by statistical model checking: temporal logic over traces, exact statistics, timed automata."""
