//! The fake host keeps the host's rules. That it keeps all of them as the host does is tested on both, in `gleaner-tests`; here is
//! what those lambdas do not reach.

mod testing {
    pub mod frames;
    pub mod lambda;
    pub mod messages;
    pub mod refusals;
    pub mod rings;
    pub mod runs;
}
