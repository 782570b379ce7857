//! Starts Gleaner's programs as users and scripts do; each file is a subject.

mod again;
mod bad_input;
mod bags;
mod cgroup;
mod check;
mod cli;
mod compile;
mod cookbook;
mod dev;
mod environment;
mod forged;
mod hostile_folders;
mod journal;
mod journal_file;
mod kernels;
mod native;
mod new;
mod python_faults;
mod report;
mod schedule;
mod scratch;
mod signals;
mod topics;
mod transcripts;
mod vehicle;
mod worker;
