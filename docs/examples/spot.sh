#!/bin/bash
# On a preemptible machine, or its successor with the same disk: repeat the same command until nothing is left.
# Exit codes: 0 done, 3 done except for units that failed repeatedly, 2 fix the command; retry after any other.
set -u
while :; do
    levelproof generate size=s levels=6M budget=1M checkpoint=10min out=data &
    job=$!
    trap 'kill -TERM "$job"; wait "$job"; exit 130' TERM INT
    wait "$job"
    code=$?
    case $code in 0 | 2 | 3) exit "$code" ;; esac
    sleep "${PAUSE:-10}"
done
