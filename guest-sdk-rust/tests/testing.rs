//! Tests that the fake host follows the rules of the host. `gleaner-rules` tests the rules
//! themselves; these tests cover their effects on a lambda.

mod testing {
    pub mod frames;
    pub mod lambda;
    pub mod messages;
    pub mod models;
    pub mod refusals;
    pub mod rings;
    pub mod runs;
}
