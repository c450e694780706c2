# Sourced by other scripts: `step TEXT COMMAND...` runs a command silently, and prints one line with
# the text and the duration. The output of a command that fails is printed.
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
