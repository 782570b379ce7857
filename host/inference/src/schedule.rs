//! The runs in progress, and the next one.
//!
//! Lambdas within their demand run one at a time. A run beyond it runs beside these, one at a time
//! as well: a backend may be unable to interrupt a run, so it must not hold up others. A run that
//! uses up its lambda's time while it lasts becomes such a run, and so are the next ones of that
//! lambda for a while, so that it cannot hold up others by it again and again. A lambda that runs
//! models at a higher rate than it has stated waits, whether others do or not. After an end of the
//! process that several models may have caused, everything runs apart, so that the next end has one
//! cause.

use std::collections::HashMap;
use std::sync::Arc;

use gleaner_protocol::inference::{AddClient, MODEL_WORKERS, ModelFaultKind};

use crate::backend::StopSignal;
use crate::client::LambdaId;
use crate::pace::{BEYOND, RunPace, TOLERANCE};
use crate::places::PlacedInput;
use crate::queue::FairQueue;
use crate::sessions::SessionId;

/// Time of a run of a lambda that states none, in ns.
const UNSTATED_NS: u64 = 200_000_000;

#[derive(Debug, Default)]
pub(crate) struct RunSchedule {
    /// Allowances by the identity of the lambda: a restart or another revision does not change when
    /// it is within its demand again.
    allowances: HashMap<String, RunAllowance>,
    queue: FairQueue<LambdaId, WaitingRun>,
    running: Vec<RunInProgress>,
    /// Time until which these have their shares, in ns.
    shared_until_ns: u64,
    last_job: u64,
}

#[derive(Debug, Default)]
struct RunAllowance {
    /// Time for which a run holds up others, in ns.
    run_ns: u64,
    beyond_until_ns: u64,
    pace: RunPace,
}

#[derive(Debug)]
pub(crate) struct WaitingRun {
    /// Identity of the lambda.
    pub(crate) account: String,
    pub(crate) session: SessionId,
    pub(crate) threads: u64,
    pub(crate) inputs: Vec<PlacedInput>,
}

#[derive(Debug)]
pub(crate) struct RunInProgress {
    pub(crate) job: u64,
    pub(crate) lambda: LambdaId,
    pub(crate) stop: Arc<StopSignal>,
    request: WaitingRun,
    /// Its part of the time so far, by the threads of all runs in progress, in ns.
    share_ns: u64,
    /// Time at which it uses up its lambda's time, in ns.
    paid_until_ns: u64,
}

impl RunSchedule {
    /// Sets the time that a lambda has stated for its models in a wake, and its rate if it
    /// `is_live`: a replay takes less time than the drive.
    pub(crate) fn allow(&mut self, lambda: &AddClient, is_live: bool) {
        let allowance = self.allowances.entry(lambda.id.clone()).or_default();
        let stated = lambda.demand.map(|stated| stated.saturating_mul(TOLERANCE));
        allowance.run_ns = stated.unwrap_or(UNSTATED_NS);
        allowance.pace.stated = lambda.pace.filter(|_| is_live);
    }

    /// Returns why a run of a lambda waits.
    pub(crate) fn cause_of_wait(&self, account: &str, now_ns: u64) -> (ModelFaultKind, String) {
        let refusal = self.allowances.get(account).and_then(|it| it.pace.refusal(now_ns));
        let others = || (ModelFaultKind::TooSlow, "has not run yet: others run before it".into());
        refusal.map_or_else(others, |reason| (ModelFaultKind::Failed, reason))
    }

    /// Returns the time from which a lambda may run models, in ns.
    fn begins_at(allowances: &HashMap<String, RunAllowance>, account: &str) -> u64 {
        allowances.get(account).map_or(0, |it| it.pace.begins_at())
    }

    pub(crate) fn push(&mut self, lambda: LambdaId, deadline: Option<u64>, run: WaitingRun) {
        self.queue.push(lambda, deadline, run);
    }

    pub(crate) fn remove(&mut self, lambda: LambdaId) {
        self.queue.remove(lambda);
    }

    pub(crate) fn is_idle(&self) -> bool {
        self.running.is_empty()
    }

    /// Requests the end of a run, or of all of them.
    pub(crate) fn stop(&self, job: Option<u64>) {
        for run in self.running.iter().filter(|run| job.is_none_or(|job| run.job == job)) {
            run.stop.stop();
        }
    }

    /// Begins the next run, and returns it with its inputs. With `is_apart`, none begins beside
    /// another one.
    pub(crate) fn begin(
        &mut self,
        is_apart: bool,
        now_ns: u64,
    ) -> Option<(&RunInProgress, Vec<PlacedInput>)> {
        self.share(now_ns);
        let Self { allowances, queue, running, last_job, .. } = self;
        if running.len() >= MODEL_WORKERS || is_apart && !running.is_empty() {
            return None;
        }
        let left_ns = |run: &WaitingRun| {
            let allowance = allowances.get(&run.account);
            allowance.filter(|it| it.beyond_until_ns <= now_ns).map_or(0, |it| it.run_ns)
        };
        let is_free = |next: &WaitingRun| {
            let differs = |run: &RunInProgress| {
                run.request.session != next.session && run.request.account != next.account
            };
            running.iter().all(differs) && Self::begins_at(allowances, &next.account) <= now_ns
        };
        let paid = running.iter().filter(|run| run.paid_until_ns > now_ns).count();
        let mut popped = None;
        if paid == 0 {
            popped = queue.pop(|next| is_free(next) && left_ns(next) > 0);
        }
        if popped.is_none() && paid == running.len() && !is_apart {
            popped = queue.pop(|next| is_free(next) && left_ns(next) == 0);
        }
        let (lambda, mut request) = popped?;
        *last_job += 1;
        let (job, paid_until_ns) = (*last_job, now_ns.saturating_add(left_ns(&request)));
        let (inputs, share_ns) = (std::mem::take(&mut request.inputs), 0);
        let stop = Arc::new(StopSignal::default());
        running.push(RunInProgress { job, lambda, stop, request, share_ns, paid_until_ns });
        running.last().map(|run| (run, inputs))
    }

    /// Returns the time at which a waiting run may begin although none ends, in ns.
    pub(crate) fn changes_at(&self, now_ns: u64) -> Option<u64> {
        let waiting: Vec<_> = self.queue.entries().collect();
        let paced = waiting.iter().map(|next| Self::begins_at(&self.allowances, &next.account));
        let paid = self.running.iter().map(|run| run.paid_until_ns);
        paid.chain(paced).filter(|at| *at > now_ns && !waiting.is_empty()).min()
    }

    /// Divides the time since the last change among the runs in progress.
    fn share(&mut self, now_ns: u64) {
        let since_ns = std::mem::replace(&mut self.shared_until_ns, now_ns);
        let all: u64 = self.running.iter().map(|run| run.request.threads).sum();
        for run in &mut self.running {
            run.share_ns += now_ns.saturating_sub(since_ns) * run.request.threads / all;
        }
    }

    /// Ends a run, which took this time. Others with many threads may have made it long: its lambda
    /// pays for its share.
    pub(crate) fn finish(&mut self, job: u64, ran_ns: u64, now_ns: u64) -> Option<RunInProgress> {
        self.share(now_ns);
        let index = self.running.iter().position(|run| run.job == job)?;
        let run = self.running.remove(index);
        if let Some(allowance) = self.allowances.get_mut(&run.request.account) {
            allowance.pace.charge(ran_ns.min(run.share_ns), now_ns);
            if ran_ns > allowance.run_ns {
                allowance.beyond_until_ns = now_ns.saturating_add(ran_ns.saturating_mul(BEYOND));
            }
        }
        Some(run)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sessions::{SessionKey, SessionTable};

    const MS: u64 = 1_000_000;
    const VICTIM: LambdaId = LambdaId(0);

    fn lambda(id: u64, demand: Option<u64>) -> AddClient {
        AddClient { id: id.to_string(), demand, ..AddClient::default() }
    }

    /// Returns the schedule of a victim that states nothing and five hostile lambdas that state
    /// 1 ms; and a function that adds a run of one of them.
    fn schedule() -> (RunSchedule, impl Fn(&mut RunSchedule, LambdaId, u64)) {
        let (mut table, mut schedule) = (SessionTable::default(), RunSchedule::default());
        let sessions = [(); 6].map(|()| table.add(SessionKey::default(), String::new()));
        (0..6).for_each(|id| schedule.allow(&lambda(id, (id > 0).then_some(MS)), true));
        let push = move |schedule: &mut RunSchedule, lambda: LambdaId, deadline| {
            let (account, session) = (lambda.0.to_string(), sessions[lambda.0 as usize]);
            let threads = if lambda == VICTIM { 1 } else { 64 };
            let run = WaitingRun { account, session, threads, inputs: vec![] };
            schedule.push(lambda, Some(deadline), run);
        };
        (schedule, push)
    }

    fn begin(schedule: &mut RunSchedule, is_apart: bool, at: u64) -> Option<(u64, u64)> {
        schedule.begin(is_apart, at).map(|(next, _)| (next.lambda.0, next.job))
    }

    #[test]
    fn lambdas_beyond_their_demand_run_beside_the_others_and_delay_none() {
        let (mut runs, push) = schedule();
        (1..6).for_each(|id| push(&mut runs, LambdaId(id), id));
        push(&mut runs, VICTIM, 400 * MS);
        // Each holds up the others for its 2 ms.
        for id in 1..6 {
            let at = (id - 1) * 2 * MS;
            assert_eq!(begin(&mut runs, false, at), Some((id, id)));
            assert_eq!(begin(&mut runs, false, at + MS), None);
            assert_eq!(runs.changes_at(at + MS), Some(at + 2 * MS));
        }
        assert_eq!(begin(&mut runs, false, 10 * MS), Some((0, 6)));
        assert_eq!(runs.changes_at(10 * MS), None, "none waits");
        runs.finish(6, 20 * MS, 30 * MS);
        (1..6).for_each(|job| drop(runs.finish(job, 2000 * MS, 2000 * MS)));
        // The next ones begin beside those within their demand, one at a time, and before none.
        (1..3).for_each(|id| push(&mut runs, LambdaId(id), id));
        push(&mut runs, VICTIM, 2400 * MS);
        for started in [Some((0, 7)), Some((1, 8)), None] {
            assert_eq!(begin(&mut runs, false, 2000 * MS), started);
        }
        runs.finish(7, 20 * MS, 2020 * MS);
        // A short run in between does not make a lambda hold up others again.
        runs.finish(8, MS, 2020 * MS);
        push(&mut runs, LambdaId(1), 3);
        push(&mut runs, VICTIM, 2600 * MS);
        for started in [Some((0, 9)), Some((2, 10)), None] {
            assert_eq!(begin(&mut runs, false, 2020 * MS), started);
        }
    }

    #[test]
    fn apart_one_runs_at_a_time_and_a_lambda_beyond_its_demand_waits() {
        let (mut runs, push) = schedule();
        push(&mut runs, LambdaId(1), 1);
        push(&mut runs, VICTIM, 2);
        assert_eq!(begin(&mut runs, true, 0), Some((1, 1)));
        assert_eq!(begin(&mut runs, true, 1000 * MS), None);
        runs.finish(1, 2000 * MS, 2000 * MS);
        push(&mut runs, LambdaId(1), 3);
        assert_eq!(begin(&mut runs, true, 2000 * MS), Some((0, 2)));
        runs.finish(2, 20 * MS, 2020 * MS);
        // A restart changes nothing.
        runs.allow(&lambda(1, Some(MS)), true);
        assert_eq!(begin(&mut runs, true, 21_999 * MS), None);
        assert_eq!(begin(&mut runs, true, 22_000 * MS), Some((1, 3)));
    }

    #[test]
    fn a_lambda_above_its_stated_rate_waits_and_its_neighbour_does_not() {
        let (mut runs, push) = schedule();
        let stated = [2000 * MS, 1_000_000 * MS];
        let hostile = AddClient { pace: Some(stated), ..lambda(1, Some(stated[0])) };
        // As after a restart: the second time changes nothing.
        (0..2).for_each(|_| runs.allow(&hostile, true));
        for (job, at) in [(1, 0), (2, 2000 * MS)] {
            push(&mut runs, LambdaId(1), at);
            assert_eq!(begin(&mut runs, false, at), Some((1, job)));
            runs.finish(job, 2000 * MS, at + 2000 * MS);
            runs.allow(&hostile, true);
        }
        // Twice what it states is 4 s in 1000 s, so its 4 s take up to then; it may begin when what
        // one wake takes is there again.
        push(&mut runs, LambdaId(1), 1);
        push(&mut runs, VICTIM, 4400 * MS);
        assert_eq!(begin(&mut runs, false, 4000 * MS), Some((0, 3)), "its deadline is later");
        runs.finish(3, 400 * MS, 4400 * MS);
        assert_eq!(begin(&mut runs, false, 499_999 * MS), None);
        assert_eq!(runs.changes_at(4400 * MS), Some(500_000 * MS));
        let (kind, cause) = runs.cause_of_wait("1", 10_000 * MS);
        let numbers = "2000.0 ms of models in a wake and a wake every 1000.0 s are stated, and \
                       4000.0 ms ran in 10.0 s";
        assert!(kind == ModelFaultKind::Failed && cause.contains(numbers), "{cause}");
        assert_eq!(runs.cause_of_wait("0", 10_000 * MS).0, ModelFaultKind::TooSlow);
        assert_eq!(begin(&mut runs, false, 500_000 * MS), Some((1, 4)));
    }

    #[test]
    fn a_lambda_that_another_one_slows_is_not_charged_for_that_and_the_other_one_is() {
        let (mut runs, push) = schedule();
        for (id, time, period) in [(0, 50 * MS, 1000 * MS), (1, 400 * MS, 6000 * MS)] {
            let stated = AddClient { pace: Some([time, period]), ..lambda(id, Some(time)) };
            runs.allow(&stated, true);
        }
        // A busy machine makes the first run long, so the next ones are beside others.
        push(&mut runs, VICTIM, 1);
        assert_eq!(begin(&mut runs, false, 0), Some((0, 1)));
        runs.finish(1, 400 * MS, 400 * MS);
        // Of 400 ms, 64 of 65 threads are charged 394 ms, which fill again in 2954 ms.
        for wake in 1..32 {
            let (at, job) = (wake * 1000 * MS, wake * 2);
            push(&mut runs, LambdaId(1), 1);
            push(&mut runs, VICTIM, 2);
            assert_eq!(begin(&mut runs, false, at), Some((1, job)));
            assert_eq!(begin(&mut runs, false, at), Some((0, job + 1)));
            (job..job + 2).for_each(|job| drop(runs.finish(job, 400 * MS, at + 400 * MS)));
        }
        let cause = |account| runs.cause_of_wait(account, 32_000 * MS).0;
        assert_eq!(cause("1"), ModelFaultKind::Failed);
        assert_eq!(cause("0"), ModelFaultKind::TooSlow, "it would be refused from the 21st on");
    }
}
