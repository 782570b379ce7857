//! Tests of the program `gleaner`, as a user starts it.
#![cfg(unix)]

mod cloud;
mod programs;
mod publish;
mod replay;
