"""``python -m mtjax`` says what the commands are."""

if __name__ == "__main__":
    print("python -m mtjax.train     trains an agent on a family of tasks; --quick is a first run")
    print("python -m mtjax.evaluate  scores, films and exports what was learned")
    print("python -m mtjax.plot      draws figures of several runs")
    print("Each takes --help.")
