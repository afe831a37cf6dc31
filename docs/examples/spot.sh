#!/bin/bash
# On a machine that may go at any time, or on the next one with the same disk: the same command until nothing is left.
# Exit codes: 0 done, 3 done but for units that failed repeatedly, 2 the command has to change; after others, again.
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
