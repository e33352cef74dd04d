//! Stride scheduling: whoever is owed most for its weight is next. Deterministic, and the measure of the lottery.
//!
//! It is the stride scheduler of Waldspurger and Weihl (1995) said in lags: an application's pass is
//! `received_i / w_i`, and `lag_i = p_i * total - received_i`, so the least pass is the largest `lag_i / w_i`.

use rand::rngs::SmallRng;

use super::share::{FairShare, Lags};
use crate::id::AppId;

/// The rule has no state: all that it goes by are the lags.
#[derive(Debug)]
pub(super) struct Stride;

impl FairShare for Stride {
    fn draw(
        &mut self,
        lags: &Lags,
        candidates: &mut dyn Iterator<Item = AppId>,
        _: &mut SmallRng,
    ) -> Option<AppId> {
        let pass = |app: AppId| -lags.due(app) / lags.share(app);
        candidates.min_by(|one, other| pass(*one).total_cmp(&pass(*other)))
    }
}
