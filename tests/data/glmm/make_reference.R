# Simulates four small user studies and fits them with lme4 and emmeans.
# Usage: Rscript make_reference.R    writes study.csv, offload.csv, counts.csv, reference.csv beside itself.
# Tests read these files only; R is needed to make them again, not to test.
suppressPackageStartupMessages({library(lme4); library(emmeans)})
set.seed(20231019)
emm_options(msg.interaction = FALSE)

intercepts <- function(group, sd) rnorm(nlevels(group), 0, sd)[group]

# 1, 2. The paper's design: 30 participants x 3 conditions x 10 episodes, 10 scenes.
study <- expand.grid(episode = 1:10, condition = c("learn_single", "plan_pop3", "solo"), participant = 1:30)
study$scene <- factor(sprintf("s%02d", (study$participant + as.integer(study$condition)) %% 10))
study$participant <- factor(sprintf("p%02d", study$participant))
means <- c(solo = 1253.17, learn_single = 936.60, plan_pop3 = 1015.05)
eta <- log(means[as.character(study$condition)]) + intercepts(study$participant, 0.3) + intercepts(study$scene, 0.2)
study$steps <- rpois(nrow(study), exp(eta + rnorm(nrow(study), 0, 0.25)))
rates <- c(solo = 0.001, learn_single = 0.12, plan_pop3 = 0.20)
eta <- qlogis(rates[as.character(study$condition)]) + intercepts(study$participant, 0.8) + intercepts(study$scene, 0.5)
study$collided <- rbinom(nrow(study), 1, plogis(eta))
study$collided[study$condition == "solo"] <- 0

# 3. Objects moved by the robot out of five: unbalanced, an interaction, a covariate.
offload <- expand.grid(episode = 1:4, robot = c("learn", "plan", "random"), home = c("large", "small"), participant = 1:20)
offload$scene <- factor(sprintf("s%d", (offload$participant + offload$episode) %% 7))
offload$participant <- factor(sprintf("p%02d", offload$participant))
offload$experience <- round(rnorm(20, 3, 1.5), 2)[offload$participant]
offload <- offload[runif(nrow(offload)) < 0.7, ]
offload <- offload[!(offload$participant %in% c("p03", "p11") & offload$robot == "plan"), ]
effect <- c(learn = -0.5, plan = 0, random = -1.4)[as.character(offload$robot)] +
  ifelse(offload$home == "small", 0.4, 0) + ifelse(offload$home == "small" & offload$robot == "plan", -0.6, 0)
eta <- effect + 0.15 * offload$experience + intercepts(offload$participant, 0.6) + intercepts(offload$scene, 0.4)
offload$objects <- 5
offload$moved <- rbinom(nrow(offload), 5, plogis(eta))

# 4. Small counts whose scenes do not differ; with this seed their estimated variance is 0: a singular fit.
set.seed(3)
counts <- expand.grid(episode = 1:6, condition = c("a", "b"), participant = 1:12)
counts$scene <- factor(sprintf("s%d", counts$episode %% 3))
counts$participant <- factor(sprintf("p%02d", counts$participant))
eta <- c(a = 0.8, b = 1.2)[as.character(counts$condition)] + intercepts(counts$participant, 0.5)
counts$events <- rpois(nrow(counts), exp(eta))

rows <- list()
put <- function(fit, quantity, name, value, se = NA, low = NA, high = NA, p = NA)
  rows[[length(rows) + 1]] <<- data.frame(fit, quantity, name, value, se, low, high, p)

report <- function(name, model, factor) {
  coefficients <- summary(model)$coefficients
  for (i in seq_len(nrow(coefficients)))
    put(name, "coefficient", rownames(coefficients)[i], coefficients[i, 1], coefficients[i, 2])
  deviations <- as.data.frame(VarCorr(model))
  for (i in seq_len(nrow(deviations))) put(name, "deviation", deviations$grp[i], deviations$sdcor[i])
  put(name, "log_likelihood", "", as.numeric(logLik(model)))
  parameters <- length(fixef(model)) + length(getME(model, "theta"))
  put(name, "dispersion", "", sum(residuals(model, "pearson")^2) / (nobs(model) - parameters))
  modes <- ranef(model)$participant
  for (level in rownames(modes)) put(name, "participant", level, modes[level, 1])
  for (scale in c("link", "response")) {
    means <- as.data.frame(confint(emmeans(model, factor, type = scale)))
    names(means)[2] <- "value"
    for (i in seq_len(nrow(means)))
      put(name, paste0("mean_", scale), as.character(means[i, 1]), means$value[i], means$SE[i], means$asymp.LCL[i], means$asymp.UCL[i])
    for (adjust in c("none", "tukey", "holm")) {
      grid <- if (scale == "link") emmeans(model, factor) else regrid(emmeans(model, factor), transform = "response")
      pairs <- as.data.frame(summary(contrast(grid, "pairwise"), infer = TRUE, adjust = adjust))
      for (i in seq_len(nrow(pairs)))
        put(name, paste0("contrast_", scale, "_", adjust), as.character(pairs$contrast[i]), pairs$estimate[i], pairs$SE[i],
            pairs$asymp.LCL[i], pairs$asymp.UCL[i], pairs$p.value[i])
    }
  }
}

# The default tolPwrss = 1e-7 moves standard errors of 0/1 models by 2 %.
tight <- function(...) glmerControl(optimizer = "bobyqa", tolPwrss = 1e-13, optCtrl = list(maxfun = 1e5, rhoend = 1e-9), ...)
study$row <- factor(seq_len(nrow(study)))
robots <- droplevels(study[study$condition != "solo", ])
report("steps", glmer(steps ~ condition + (1 | participant) + (1 | scene), study, poisson, control = tight()), "condition")
report("steps_observation",
       glmer(steps ~ condition + (1 | participant) + (1 | scene) + (1 | row), study, poisson, control = tight()), "condition")
report("collided", glmer(collided ~ condition + (1 | participant) + (1 | scene), robots, binomial, control = tight()), "condition")
report("offload", glmer(cbind(moved, objects - moved) ~ robot * home + experience + (1 | participant) + (1 | scene),
                        offload, binomial, control = tight()), "robot")
report("counts", glmer(events ~ condition + (1 | participant) + (1 | scene), counts, poisson, control = tight()), "condition")

write.csv(study[c("participant", "scene", "condition", "episode", "steps", "collided")], "study.csv", row.names = FALSE, quote = FALSE)
write.csv(offload[c("participant", "scene", "robot", "home", "experience", "objects", "moved")], "offload.csv", row.names = FALSE, quote = FALSE)
write.csv(counts[c("participant", "scene", "condition", "events")], "counts.csv", row.names = FALSE, quote = FALSE)
reference <- do.call(rbind, rows)
for (column in c("value", "se", "low", "high", "p")) reference[[column]] <- signif(reference[[column]], 8)
write.csv(reference, "reference.csv", row.names = FALSE, quote = FALSE, na = "")
cat(R.version.string, "lme4", as.character(packageVersion("lme4")), "emmeans", as.character(packageVersion("emmeans")), "\n")
