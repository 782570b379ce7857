//! The fake host keeps the host's rules. What these are is tested in `gleaner-rules`; here is what
//! a lambda's author sees of them.

mod testing {
    pub mod frames;
    pub mod lambda;
    pub mod messages;
    pub mod refusals;
    pub mod rings;
    pub mod runs;
}
