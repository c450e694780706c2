# Sourced by other scripts.

# step TEXT COMMAND... runs a command silently, and prints one line with the text and the duration. The
# output of a command that fails is printed.
step_log=$(mktemp)

step() {
    step_text=$1
    shift
    step_begin=$(date +%s)
    printf '%s: %s ... ' "$step_of" "$step_text"
    if "$@" >"$step_log" 2>&1; then
        echo "$(($(date +%s) - step_begin)) s"
    else
        echo "failed"
        cat "$step_log" >&2
        exit 1
    fi
}

# wheels_for MACHINE PYTHON_VERSION prints the options with which pip takes wheels of a processor and a
# version of Python, also those that this machine cannot run.
wheels_for() {
    printf '%s ' --only-binary=:all: --implementation cp --python-version "$2" --platform "manylinux2014_$1" \
        --platform "linux_$1"
    for oldest in 2_34 2_31 2_28 2_27 2_26 2_24 2_17 2_12 2_5; do
        printf '%s ' --platform "manylinux_${oldest}_$1"
    done
}
